"""Changes of a run's settings while it goes on, and what a machine knows of them.

A change is announced before it is in force, with the simulated time T from which on it is. Each
machine takes the announcement as an input, and applies the change at its own time, the first that
is not before T. So what happens does not depend on when exactly it heard of it. One that hears of
it after its own time has passed T applies it late, and says so.
"""

import json
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

from pydantic import ValidationError

from noack.config.runtime_parameters import LOSS, MANSD, SETPOINT, text_of, trigger_parameters
from noack.config.scenario import Scenario
from noack.config.scenario_changes import content_with_settings, with_settings
from noack.config.toml_file import validated
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.protocol.machine_interface import Machine, Notice, Record
from noack.protocol.record_tables import CHANGE_BYTES

T = TypeVar("T")

LATE = "violation"
"""Level of the notice of a process that applies a change late."""


class ParameterChange(NamedTuple):
    """Settings that are in force from a time on."""

    number: int
    """Of the run's changes, as they were announced."""
    t_ns: int
    """T."""
    settings: Mapping[str, Any]
    """Values by keys of the scenario."""

    @property
    def data(self) -> bytes:
        """The settings as they stand in the record."""
        return settings_bytes(self.settings)


def settings_bytes(settings: Mapping[str, Any]) -> bytes:
    """Settings as JSON, filled up with zeros to the width that the record has for them.

    Raises:
        CallerError: they do not fit.
    """
    data = json.dumps(settings, sort_keys=True, separators=(",", ":")).encode()
    if len(data) > CHANGE_BYTES:
        raise CallerError(
            f"a change has {len(data)} bytes as JSON; at most {CHANGE_BYTES} can be recorded"
        )
    return data.ljust(CHANGE_BYTES, b"\0")


def settings_of(data: bytes) -> dict[str, Any]:
    """Read settings back from the record.

    Raises:
        ValueError: these are none.
    """
    found = json.loads(data.rstrip(b"\0"))
    if not isinstance(found, dict):
        raise ValueError("a change is a table of keys and values")
    return found


def changed(scenario: Scenario, settings: Mapping[str, Any]) -> Scenario:
    """Return a scenario with other settings, validated as a whole.

    Args:
        scenario: the scenario.
        settings: values by keys.

    Raises:
        CallerError: one line per mistake.
    """
    settings_bytes(settings)
    try:
        return with_settings(scenario, settings)
    except ValidationError:
        return validated(Scenario, content_with_settings(scenario, settings), "the change")
    except ValueError as error:
        raise CallerError(f"the change: {error}") from None


def current_parameters(scenario: Scenario) -> dict[str, Any]:
    """What can be changed during a run, and its values."""
    trigger = scenario.trigger
    loss = scenario.network.loss.model_dump(mode="json", exclude_none=True)
    values = {
        key: getattr(trigger, key.removeprefix("trigger.")) for key in trigger_parameters(trigger)
    }
    n, _ = scenario.model.dimensions
    setpoint = list(scenario.controller.setpoint or [0.0] * n)
    return {LOSS: loss, MANSD: scenario.network.mansd, **values, SETPOINT: setpoint}


def scheduled(scenario: Scenario) -> list[ParameterChange]:
    """The changes that a scenario has written down."""
    return [
        ParameterChange(number, one.at_ns, dict(one.set))
        for number, one in enumerate(scenario.changes)
    ]


CHANGED = "change"
"""Level of the notice of a change."""


def said_of(change: ParameterChange, more: str = "") -> Notice:
    """The line of the run's log that tells of a change."""
    text = f"{text_of(change.settings)} from {change.t_ns / NS_PER_S:.3f} s on{more}"
    return Notice(change.t_ns, CHANGED, text)


class ReconfigurableMachine(Machine[T], Protocol[T]):
    """A machine whose settings may change during a run."""

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Take a change that is in force from its time on; answers with one row.

        Raises:
            CallerError: with it, the scenario would not be a valid one; nothing is changed.
        """
        ...


class FixedMachine:
    """Part of machines whose settings stay as they are: those of the acknowledgement baseline."""

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Refuse a change.

        Raises:
            CallerError: always.
        """
        raise CallerError(f"nothing can be changed here during a run: {text_of(change.settings)}")


class AppliedParameters(NamedTuple):
    """A scenario, and since when it is in force in a machine's own time."""

    since_ns: int
    number: int
    """Of the change; −1 for the run's own scenario."""
    settings: Mapping[str, Any]
    scenario: Scenario
    prepared: Any
    """What the machine made of the scenario when it was told."""


class ChangeSchedule:
    """The scenarios of a run, one after the other, as a machine has been told.

    Args:
        scenario: the resolved scenario that the run begins with.
        prepare: makes what the machine will need of a scenario, before it is in force.
    """

    def __init__(
        self, scenario: Scenario, prepare: Callable[[Scenario], Any] = lambda scenario: None
    ) -> None:
        self._prepare = prepare
        self._all = [AppliedParameters(-(2**63), -1, {}, scenario, None)]
        self._taken = 1
        self.next_ns: int | None = None
        """From when on the next one is in force that has not been taken; None if none is known."""

    def announce(
        self, table: str, change: ParameterChange, number: int, now_ns: int, reached_ns: int
    ) -> list[Record | Notice]:
        """Take a change; return its row, and what is to be said of it.

        Args:
            table: of the machine, for its changes.
            change: the change.
            number: of the machine's input.
            now_ns: when it is told.
            reached_ns: how far the machine's own time has come, with the settings before.

        Raises:
            CallerError: with it, the scenario would not be a valid one; nothing is changed.
        """
        since_ns = max(change.t_ns, reached_ns + 1)
        entry = AppliedParameters(
            since_ns, change.number, change.settings, self._all[0].scenario, None
        )
        every = [*self._all]
        first = bisect(every, (since_ns, change.number), key=lambda one: (one.since_ns, one.number))
        every.insert(first, entry)
        for place in range(first, len(every)):
            scenario = changed(every[place - 1].scenario, every[place].settings)
            prepared = self._prepare(scenario)
            every[place] = every[place]._replace(scenario=scenario, prepared=prepared)
        self._all = every
        self._look()
        row = (number, change.number, change.t_ns, now_ns, since_ns, change.data)
        outputs: list[Record | Notice] = [Record(table, row)]
        if since_ns > change.t_ns:
            text = (
                f"heard of a change too late: {text_of(change.settings)} was to be in force from "
                f"{change.t_ns / NS_PER_S:.3f} s on, and is so from {since_ns / NS_PER_S:.3f} s on"
            )
            outputs.append(Notice(since_ns, LATE, text))
        return outputs

    def take(self, t_ns: int) -> AppliedParameters | None:
        """The next scenario that is in force at a time and has not been taken; None if none is."""
        if self.next_ns is None or self.next_ns > t_ns:
            return None
        found = self._all[self._taken]
        self._taken += 1
        self._look()
        return found

    @property
    def last(self) -> Scenario:
        """The scenario with all changes that are known."""
        return self._all[-1].scenario

    def between(self, first_ns: int, last_ns: int) -> Iterator[Scenario]:
        """The scenarios that are in force at any time from one to another."""
        for place, one in enumerate(self._all):
            ended = place + 1 < len(self._all) and self._all[place + 1].since_ns <= first_ns
            if one.since_ns <= last_ns and not ended:
                yield one.scenario

    def _look(self) -> None:
        waiting = self._all[self._taken :]
        self.next_ns = waiting[0].since_ns if waiting else None

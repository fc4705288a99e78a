"""Changes of a run's settings during the run, and the changes that a machine has received.

A change is announced before it takes effect, together with the simulated time T at which it takes
effect. Each machine takes the announcement as an input, and applies the change at its own first
time at or after T. So the result does not depend on when exactly the announcement arrived. If it
arrives after the machine's own time has passed T, the machine applies the change late and logs a
notice.
"""

import json
from bisect import bisect
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import Generic, NamedTuple, TypeVar

from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.errors import CallerError
from netem.core.json_text import parse_json
from netem.core.settings_section import ReadTable, Table
from noack.protocol.record_tables import CHANGE_BYTES
from noack.protocol.roles import Notice, Record
from noack.scenario.runtime_parameters import CONSTRAINTS, LOSS, MANSD, SETPOINT, text_of, trigger_parameters
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_checks import with_settings
from noack.scenario.sections import PlantSection

_shared_tables = attrgetter(*(Scenario.model_fields.keys() - {"name", "plant", "seeds"}))
_shared_of_plant = attrgetter(*(PlantSection.model_fields.keys() - {"initial_state", "A", "B"}))
LATE = "violation"  # level of the notice of a process that applies a change late


class ParameterChange(NamedTuple):
    """Settings that take effect at a time."""

    number: int  # number of the change, in the order in which the run's changes were announced
    t_ns: int  # T, the time from which the settings are in force
    settings: ReadTable  # values by keys of the scenario


def settings_bytes(settings: ReadTable) -> bytes:
    """Return settings as JSON, padded with zeros to the width of the record's column.

    Raise CallerError if they are too long for the column.
    """
    data = json.dumps(settings, sort_keys=True, separators=(",", ":")).encode()
    if len(data) > CHANGE_BYTES:
        raise CallerError(f"a change has {len(data)} bytes as JSON; at most {CHANGE_BYTES} can be recorded")
    return data.ljust(CHANGE_BYTES, b"\0")


def settings_of(data: bytes) -> Table:
    """Read settings from the record; raise ValueError if the data are not settings."""
    settings = parse_json(data.rstrip(b"\0"))
    if not isinstance(settings, dict):
        raise ValueError("a change is a table of keys and values")
    return settings


def changed(scenario: Scenario, settings: ReadTable) -> Scenario:
    """Return a scenario with other settings, validated as a whole.

    Raise CallerError with one line per mistake.
    """
    settings_bytes(settings)
    try:
        return with_settings(scenario, settings)
    except ValueError as error:
        raise CallerError("\n".join(f"the change: {line}" for line in str(error).splitlines())) from None


def current_parameters(scenario: Scenario) -> Table:
    """Return the parameters that can be changed during a run, with their values."""
    trigger = scenario.trigger
    loss = scenario.network.loss.content()
    values = {key: getattr(trigger, key.removeprefix("trigger.")) for key in trigger_parameters(trigger)}
    setpoint = list(scenario.controller.setpoint or [0.0] * scenario.model.plant_states)
    network = {
        LOSS: loss,
        MANSD: scenario.network.mansd,
        CONSTRAINTS: [constraint.model_dump(mode="json") for constraint in scenario.network.constraints],
    }
    return {**network, **values, SETPOINT: setpoint}


def scheduled(scenario: Scenario) -> list[ParameterChange]:
    """Return the changes that a scenario schedules."""
    return [ParameterChange(i, change.at_ns, dict(change.set)) for i, change in enumerate(scenario.changes)]


def settings_key(resolved: Scenario) -> tuple[int, ...]:
    """Return what resolved loops of one entry of [[loops]] have in common.

    Loops with the same key differ in their names, seeds and plants' draws only. A key is of the
    identities of their tables, so it is valid while the loops exist.
    """
    return tuple(map(id, _shared_tables(resolved) + _shared_of_plant(resolved.plant)))


CHANGED = "change"  # level of the notice of a change


def change_notice(change: ParameterChange, suffix: str = "") -> Notice:
    """Return the notice of a change for the run's log."""
    text = f"{text_of(change.settings)} from {change.t_ns / NS_PER_S:.3f} s on{suffix}"
    return Notice(change.t_ns, CHANGED, text)


def announcement_outputs(
    table: str, change: ParameterChange, number: int, now_ns: int, since_ns: int
) -> list[Record | Notice]:
    """Return the row of an announcement in a machine's ``table``, and a notice if it is late.

    The announcement is the machine's input ``number``, at ``now_ns``; the change is in force from
    ``since_ns`` on.
    """
    row = (number, change.number, change.t_ns, now_ns, since_ns, settings_bytes(change.settings))
    outputs: list[Record | Notice] = [Record(table, row)]
    if since_ns > change.t_ns:
        text = (
            f"change received too late: {text_of(change.settings)}, due at "
            f"{change.t_ns / NS_PER_S:.3f} s, applies from {since_ns / NS_PER_S:.3f} s on"
        )
        outputs.append(Notice(since_ns, LATE, text))
    return outputs


Prepared = TypeVar("Prepared", covariant=True)


class AppliedParameters(NamedTuple, Generic[Prepared]):
    """A scenario, and the machine's own time from which it is in force."""

    since_ns: int
    number: int  # number of the change; −1 for the run's initial scenario
    settings: ReadTable
    scenario: Scenario
    prepared: Prepared | None
    """Data that the machine computed from the scenario when the change was announced."""


class _ChangedScenario(NamedTuple, Generic[Prepared]):
    """A scenario with a change."""

    scenario: Scenario
    prepared: Prepared | None
    settings: ReadTable
    """Those of the change: while they exist, no other object has their identity."""


class ChangeSchedule(Generic[Prepared]):
    """The scenarios of a run in the order of time, as announced to a machine.

    ``prepare`` computes the data that the machine needs of a scenario, before it is in force.
    """

    def __init__(self, scenario: Scenario, prepare: Callable[[Scenario], Prepared] | None = None) -> None:
        self._prepare = prepare
        self._results: dict[tuple[tuple[int, int], ...], _ChangedScenario[Prepared]] = {}
        """By number and identity of the settings of each change so far."""
        self._timeline = [AppliedParameters[Prepared](-(2**63), -1, {}, scenario, None)]
        self._taken = 1

    def for_similar_loop(self, scenario: Scenario) -> "ChangeSchedule[Prepared]":
        """Return a schedule for a loop that differs in its draws only.

        What the same changes make of the scenario is computed once for both.
        """
        schedule = ChangeSchedule(scenario, self._prepare)
        schedule._results = self._results
        return schedule

    def announce(
        self, table: str, change: ParameterChange, number: int, now_ns: int, reached_ns: int
    ) -> list[Record | Notice]:
        """Schedule a change; return its row in the machine's ``table``, and a notice if it is late.

        The announcement is the machine's input ``number``, at ``now_ns``. The machine has used the
        previous settings up to ``reached_ns`` of its own time. Raise CallerError, and change
        nothing, if the scenario would be invalid.
        """
        since_ns = max(change.t_ns, reached_ns + 1)
        self._timeline = self._with_change(change, since_ns)
        return announcement_outputs(table, change, number, now_ns, since_ns)

    def check(self, change: ParameterChange, reached_ns: int) -> None:
        """Raise CallerError if the scenario would be invalid after a change; announce nothing."""
        self._with_change(change, max(change.t_ns, reached_ns + 1))

    def _with_change(self, change: ParameterChange, since_ns: int) -> list[AppliedParameters[Prepared]]:
        """Return the scenarios with a change that is in force from a time on."""
        entry = AppliedParameters[Prepared](
            since_ns, change.number, change.settings, self._timeline[0].scenario, None
        )
        timeline = [*self._timeline]
        first = bisect(timeline, (since_ns, change.number), key=attrgetter("since_ns", "number"))
        timeline.insert(first, entry)
        for index in range(first, len(timeline)):
            # A change that was refused has left its number to another one.
            key = tuple((applied.number, id(applied.settings)) for applied in timeline[1 : index + 1])
            if key not in self._results:
                scenario, settings = timeline[index - 1].scenario, timeline[index].settings
                scenario = changed(scenario, settings)
                prepared = self._prepare(scenario) if self._prepare is not None else None
                self._results[key] = _ChangedScenario(scenario, prepared, settings)
            result = self._results[key]
            timeline[index] = timeline[index]._replace(scenario=result.scenario, prepared=result.prepared)
        return timeline

    @property
    def next_ns(self) -> int:
        """Time at which the next scenario that is not yet applied takes effect."""
        return self._timeline[self._taken].since_ns if self._taken < len(self._timeline) else NEVER_NS

    def take(self, t_ns: int) -> Sequence[AppliedParameters[Prepared]]:
        """Return the scenarios that are due at a time and not yet applied, in their order."""
        due = [applied for applied in self._timeline[self._taken :] if applied.since_ns <= t_ns]
        self._taken += len(due)
        return due

    @property
    def has_changes(self) -> bool:
        """Whether a change has been announced."""
        return len(self._timeline) > 1

    @property
    def all(self) -> Sequence[AppliedParameters[Prepared]]:
        """The scenarios in the order of their times, the first one from the start on."""
        return tuple(self._timeline)

    @property
    def last(self) -> Scenario:
        """The scenario with all announced changes."""
        return self._timeline[-1].scenario

    def at(self, t_ns: int) -> AppliedParameters[Prepared]:
        """The scenario that is in force at a time."""
        return self._timeline[bisect(self._timeline, t_ns, key=attrgetter("since_ns")) - 1]

    def between(self, first_ns: int, last_ns: int) -> Iterator[Scenario]:
        """Return the scenarios that are in force at any time within an interval."""
        for index, applied in enumerate(self._timeline):
            has_ended = index + 1 < len(self._timeline) and self._timeline[index + 1].since_ns <= first_ns
            if applied.since_ns <= last_ns and not has_ended:
                yield applied.scenario

"""The changes of settings during a run, from its record."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cosim.record.run_record import Rows, RunRecord
from noack.config.parameter_changes import ChangeSchedule, ParameterChange, settings_of
from noack.config.resolution import loop_of
from noack.config.runtime_parameters import is_of_loss_alone
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import ModelFlow
from noack.protocol.record_tables import CONTROLLER_SETTING, OWNER, SETTINGS
from noack.protocol.topology import CHANGEABLE

NEVER_NS = 2**63 - 1


class RecordedChange(NamedTuple):
    """A change of settings, and the times at which the processes applied it."""

    change: ParameterChange
    since_ns: Mapping[str, int]
    """Time from which it was in force, by process, without processes that never received it."""
    scenario: Scenario
    """The scenario from then on."""

    @property
    def first_ns(self) -> int:
        """The planned time, or earlier if a process applied it before."""
        return min(self.change.t_ns, *self.since_ns.values())

    @property
    def everywhere_ns(self) -> int:
        """The time from which it was in force in every process."""
        return max(self.since_ns.get(role, NEVER_NS) for role in CHANGEABLE)

    @property
    def late(self) -> dict[str, int]:
        """Processes that applied it after its time, with their times."""
        return {role: ns for role, ns in self.since_ns.items() if ns > self.change.t_ns}

    @property
    def touches_claims(self) -> bool:
        """Whether a claim depends on the changed settings."""
        return not is_of_loss_alone(self.change.settings)


def changes_of(record: RunRecord) -> list[RecordedChange]:
    """Return the changes of a run, in the order in which they came into force.

    Invalid changes, from a damaged record, are omitted. The record of a network of several loops
    has the settings of the network alone.
    """
    since: dict[int, dict[str, int]] = {}
    found: dict[int, ParameterChange] = {}
    for table in (one for one in SETTINGS if one in record.tables):
        for change, since_ns in _changes_in(record[table]):
            found.setdefault(change.number, change)
            since.setdefault(change.number, {}).setdefault(OWNER[table], since_ns)
    made: list[RecordedChange] = []
    scenario = record.scenario
    schedule = ChangeSchedule(scenario)
    for number, change in sorted(found.items(), key=lambda one: (one[1].t_ns, one[0])):
        if _add(schedule, change, change.t_ns):
            taken = schedule.take(change.t_ns)
            assert taken is not None
            made.append(RecordedChange(change, since[number], taken.scenario))
    return made


def model_flow(scenario: Scenario, received: Rows) -> ModelFlow:
    """The flow of the controller's model in a run, with its set-points."""
    loop, schedule = loop_of(scenario), ChangeSchedule(scenario)
    flow, known = ModelFlow(loop.H, loop.setpoint), set()
    for change, since_ns in _changes_in(received):
        if change.number not in known:  # a restarted controller receives it again
            known.add(change.number)
            _add(schedule, change, since_ns)
    while (taken := schedule.take(NEVER_NS)) is not None:
        flow.change(taken.since_ns, loop_of(taken.scenario).setpoint)
    return flow


def claimed_until_s(received: Rows) -> float:
    """Return the time of the first change of a table that ends the claims; infinite if none."""
    ends_ns = [
        change.t_ns for change, _ in _changes_in(received) if not is_of_loss_alone(change.settings)
    ]
    return min(ends_ns, default=np.inf) / NS_PER_S


def model_flow_of(record: RunRecord) -> ModelFlow:
    """The flow of the controller's model in a run."""
    return model_flow(record.scenario, record[CONTROLLER_SETTING])


def _changes_in(rows: Rows) -> list[tuple[ParameterChange, int]]:
    found = []
    for row in rows[np.argsort(rows["input"], kind="stable")]:
        try:
            settings = settings_of(row["change"].tobytes())
        except ValueError:
            continue
        found.append(
            (
                ParameterChange(int(row["sequence"]), int(row["t_ns"]), settings),
                int(row["since_ns"]),
            )
        )
    return found


def _add(schedule: ChangeSchedule, change: ParameterChange, since_ns: int) -> bool:
    try:
        schedule.announce("", change, 0, 0, since_ns - 1)
    except CallerError:
        return False
    return True

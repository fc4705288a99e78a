"""Events of a run: changes of settings, the outcome of each packet, times of inputs."""

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.rows import Rows, messages_in
from cosim.record.run_record import RunRecord
from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.errors import CallerError
from netem.core.packet_rows import NETEM_PACKET, NETEM_RELEASE, effective
from noack.core.references import ModelFlow, Reference, ReferenceInForce
from noack.protocol.record_tables import CONTROLLER_SETTING, NO_SEQUENCE, OWNER, SETTINGS, direction_of
from noack.protocol.roles import CHANGEABLE
from noack.protocol.wire_format import Flow
from noack.scenario.parameter_changes import ChangeSchedule, ParameterChange, settings_of
from noack.scenario.resolution import loop_of, reference_of
from noack.scenario.runtime_parameters import is_of_loss_alone
from noack.scenario.scenario import Scenario


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
    def touches_claims(self) -> bool:
        """Whether a claim depends on the changed settings."""
        return not is_of_loss_alone(self.change.settings)


@lru_cache(maxsize=1)
def changes_of(record: RunRecord) -> list[RecordedChange]:
    """Return the changes of a run, in the order in which they came into force.

    Invalid changes, from a damaged record, are omitted. The record of a network of several loops
    has the settings of the network alone.
    """
    since: dict[int, dict[str, int]] = {}
    changes: dict[int, ParameterChange] = {}
    for table in (name for name in SETTINGS if name in record.tables):
        for change, since_ns in _changes_in(record[table]):
            changes.setdefault(change.number, change)
            since.setdefault(change.number, {}).setdefault(OWNER[table], since_ns)
    recorded_changes: list[RecordedChange] = []
    if not changes:
        return recorded_changes
    scenario = record.scenario
    schedule = ChangeSchedule[None](scenario)
    for number, change in sorted(changes.items(), key=lambda numbered: (numbered[1].t_ns, numbered[0])):
        if _add(schedule, change, change.t_ns):
            (applied,) = schedule.take(change.t_ns)
            recorded_changes.append(RecordedChange(change, since[number], applied.scenario))
    return recorded_changes


def model_flow(scenario: Scenario, rows: Rows) -> ModelFlow:
    """The flow of the controller's model in a run, with its reference."""
    loop, schedule = loop_of(scenario), ChangeSchedule[None](scenario)
    in_force = ReferenceInForce(loop.reference, loop.n, loop.m)
    for change, since_ns in _changes_in(rows):
        _add(schedule, change, since_ns)
    for applied in schedule.take(NEVER_NS):
        in_force.change(applied.since_ns, reference_of(applied.scenario))
    return ModelFlow(loop.H, in_force.reference if in_force.moves else None)


def reference_in_run(record: RunRecord) -> Reference | None:
    """Return the reference that a run followed, with the changes of its set-point; None if it was 0."""
    loop = loop_of(record.scenario)
    in_force = ReferenceInForce(loop.reference, loop.n, loop.m)
    for change in changes_of(record):
        in_force.change(change.first_ns, reference_of(change.scenario))
    return in_force.reference if in_force.moves else None


def claimed_until_s(rows: Rows) -> float:
    """Return the time of the first change of a table that ends the claims; infinite if none."""
    ends_ns = [change.t_ns for change, _ in _changes_in(rows) if not is_of_loss_alone(change.settings)]
    return min(ends_ns, default=np.inf) / NS_PER_S


def model_flow_of(record: RunRecord) -> ModelFlow:
    """The flow of the controller's model in a run."""
    return model_flow(record.scenario, record[CONTROLLER_SETTING])


def _changes_in(rows: Rows) -> list[tuple[ParameterChange, int]]:
    changes = []
    for row in sorted(rows, key=lambda row: int(row["input"])):
        try:
            settings = settings_of(row["change"].tobytes())
        except ValueError:
            continue
        changes.append(
            (
                ParameterChange(int(row["sequence"]), int(row["t_ns"]), settings),
                int(row["since_ns"]),
            )
        )
    return changes


def _add(schedule: ChangeSchedule[None], change: ParameterChange, since_ns: int) -> bool:
    try:
        schedule.announce(table="", change=change, number=0, now_ns=0, reached_ns=since_ns - 1)
    except CallerError:
        return False
    return True


class PacketOutcome(NamedTuple):
    """The outcomes of k updates."""

    sequence: NDArray[np.int64]
    event_ns: NDArray[np.int64]
    now_ns: NDArray[np.int64]
    """Time of arrival at the network emulator."""
    fate: NDArray[np.int8]
    lost: NDArray[np.bool_]
    """Dropped, corrupted, or delivered out of order (stale)."""
    in_flight: NDArray[np.bool_]
    """Not yet forwarded when the run ended."""
    due_ns: NDArray[np.int64]
    """When it was to leave the network emulator; the time of arrival if it was not delayed."""

    @property
    def forwarded(self) -> NDArray[np.bool_]:
        """Forwarded intact, and before every newer update."""
        return ~self.lost & ~self.in_flight

    def loss_bursts(self) -> NDArray[np.int64]:
        """The lengths of all bursts of consecutive losses, in order."""
        steps = np.diff(self.lost.astype(np.int8), prepend=0, append=0)
        return np.flatnonzero(steps < 0) - np.flatnonzero(steps > 0)

    def longest_loss_burst(self) -> int:
        """Largest number of consecutive losses."""
        return int(self.loss_bursts().max(initial=0))

    def losses_in(self, packets: int) -> NDArray[np.int64]:
        """The number of losses in each ``packets`` consecutive updates; or in all, if fewer."""
        lost = np.append(0, np.cumsum(self.lost))
        width = min(packets, len(self.lost))
        return np.asarray(lost[width:] - lost[: len(lost) - width])


@lru_cache(maxsize=4)
def packet_outcomes(record: RunRecord, flow: Flow = Flow.UPDATE) -> PacketOutcome:
    """Return the outcomes of a flow's datagrams that reached the network emulator."""
    departures = _released(record, flow)
    batches = [*record.batches(NETEM_PACKET)] or [np.zeros(0, record.tables[NETEM_PACKET])]
    parts = [_outcomes(record.with_departures(rows), flow, *departures) for rows in batches]
    return PacketOutcome(*map(np.concatenate, zip(*parts, strict=True)))


def _released(record: RunRecord, flow: Flow) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the numbers of the delayed datagrams that left, with whether each was stale."""
    direction = direction_of(flow)
    has_one_flow = len(record.scenario.network.flows) == 1
    releases = record.columns(
        NETEM_RELEASE,
        "sequence",
        "flow",
        "copy",
        "stale",
        where=lambda rows: np.full(len(rows), has_one_flow) | (rows["flow"] == direction),
    )
    return 2 * releases["sequence"] + releases["copy"], releases["stale"] != 0


def _outcomes(
    packets: Rows, flow: Flow, forwarded: NDArray[np.int64], was_stale: NDArray[np.bool_]
) -> PacketOutcome:
    rows, sequence, event_ns = messages_in(packets, flow)
    # Of a datagram and its copy, the first intact one counts; it may be the copy.
    copy = (rows["bit"] >= 0).astype(np.int64)
    numbers = 2 * rows["sequence"] + copy
    effectively = effective(rows["fate"])
    stale = np.isin(numbers, forwarded[was_stale]) if was_stale.any() else np.zeros(len(numbers), np.bool_)
    due_ns = np.maximum(np.where(copy == 1, rows["copy_ns"], rows["release_ns"]), rows["now_ns"])
    in_flight = effectively & (due_ns > rows["now_ns"])
    in_flight[in_flight] = ~np.isin(numbers[in_flight], forwarded)
    fate, lost = rows["fate"].astype(np.int8), ~effectively | stale
    return PacketOutcome(sequence, event_ns, rows["now_ns"].copy(), fate, lost, in_flight, due_ns)


class ActuationTimes:
    """The model times of the actuations that the plant received, part by part of its steps."""

    def __init__(self) -> None:
        self._sequence, self._t_ns = np.zeros((2, 0), np.int64)

    def add(self, actuations: Rows) -> None:
        """Add rows of actuations, in their order."""
        self._sequence = np.append(self._sequence, actuations["sequence"])
        self._t_ns = np.append(self._t_ns, actuations["t_ns"])

    def of_newest(self, newest: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the model times of the newest actuations of the next steps, and which are known.

        Both have shape (k,), as the sequence numbers ``newest``. The time is 0 before the first
        actuation, and where it is unknown because the actuation is not recorded.
        """
        index = np.searchsorted(self._sequence, newest)
        is_recorded = np.append(self._sequence, NO_SEQUENCE)[index] == newest
        is_any = newest != NO_SEQUENCE
        times_ns = np.where(is_recorded & is_any, np.append(self._t_ns, 0)[index], 0)
        if len(newest):  # a later step has the newest of these actuations, or a later one
            self._sequence, self._t_ns = self._sequence[index[-1] :], self._t_ns[index[-1] :]
        return times_ns, is_recorded | ~is_any

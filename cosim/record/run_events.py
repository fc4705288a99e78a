"""Events of a run: changes of settings, the outcome of each packet, times of inputs, divergence.

A run diverged if its state is not finite, or far above the run's scale and still growing. The scale
is the largest of these values, in units of ‖x‖:

* ‖x‖ in the first tenth of the run,
* the set-points x_r,
* the trigger's initial threshold and its floor, and
* the integral of each later step disturbance over the rest of the run, the largest possible change
  of x.

A run with a finite state diverged if the largest ‖x‖ of its last tenth is more than ``GROWTH``
times that scale and more than twice the largest ‖x‖ of its first seven tenths. An unstable loop
e^{λt} meets this from λT ≈ 7.7 on, where T is the length of the run. In a shorter run, divergence
cannot be distinguished from a transient. A run that is disturbed, saturated or in a limit cycle
does not meet the criterion.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_record import Rows, RunRecord
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, ModelFlow, Vector, all_entries, row_norms
from noack.disturbances.step import StepDisturbance
from noack.protocol.record_tables import (
    CONTROLLER_SETTING,
    NETEM_PACKET,
    NETEM_RELEASE,
    NO_SEQUENCE,
    OWNER,
    SETTINGS,
    direction_of,
    effective,
)
from noack.protocol.roles import CHANGEABLE
from noack.protocol.wire_format import HEADER_ROW, MAGIC, VERSIONS, Flow
from noack.scenario.parameter_changes import ChangeSchedule, ParameterChange, settings_of
from noack.scenario.resolution import loop_of, policy_of
from noack.scenario.runtime_parameters import is_of_loss_alone
from noack.scenario.scenario import Scenario

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
    made: list[RecordedChange] = []
    if not changes:
        return made
    scenario = record.scenario
    schedule = ChangeSchedule[None](scenario)
    for number, change in sorted(changes.items(), key=lambda numbered: (numbered[1].t_ns, numbered[0])):
        if _add(schedule, change, change.t_ns):
            (taken,) = schedule.take(change.t_ns)
            made.append(RecordedChange(change, since[number], taken.scenario))
    return made


def model_flow(scenario: Scenario, received: Rows) -> ModelFlow:
    """The flow of the controller's model in a run, with its set-points."""
    loop, schedule = loop_of(scenario), ChangeSchedule[None](scenario)
    flow, known = ModelFlow(loop.H, loop.setpoint), set()
    for change, since_ns in _changes_in(received):
        if change.number not in known:  # a restarted controller receives it again
            known.add(change.number)
            _add(schedule, change, since_ns)
    for taken in schedule.take(NEVER_NS):
        flow.change(taken.since_ns, loop_of(taken.scenario).setpoint)
    return flow


def claimed_until_s(received: Rows) -> float:
    """Return the time of the first change of a table that ends the claims; infinite if none."""
    ends_ns = [change.t_ns for change, _ in _changes_in(received) if not is_of_loss_alone(change.settings)]
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
        schedule.announce("", change, 0, 0, since_ns - 1)
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
    released = _released(record, flow)
    batches = [*record.source.batches(NETEM_PACKET)] or [np.zeros(0, record.tables[NETEM_PACKET])]
    parts = [_outcomes(record.with_departures(rows), flow, *released) for rows in batches]
    return PacketOutcome(*map(np.concatenate, zip(*parts, strict=True)))


def _released(record: RunRecord, flow: Flow) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the numbers of the delayed datagrams that left, with whether each was stale."""
    direction = direction_of(flow)
    every = len(record.scenario.network.flows) == 1
    releases = record.columns(
        NETEM_RELEASE,
        "sequence",
        "flow",
        "copy",
        "stale",
        where=lambda rows: np.full(len(rows), every) | (rows["flow"] == direction),
    )
    return 2 * releases["sequence"] + releases["copy"], releases["stale"] != 0


def _outcomes(
    packets: Rows, flow: Flow, forwarded: NDArray[np.int64], was_stale: NDArray[np.bool_]
) -> PacketOutcome:
    rows, sequence, event_ns = updates_in(packets, flow)
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


def updates_in(packets: Rows, flow: Flow = Flow.UPDATE) -> tuple[Rows, NDArray[np.int64], NDArray[np.int64]]:
    """Select the loop's messages of a flow from the packets that reached the network emulator.

    The emulator reads no payload, so the packets' headers are read here.

    Returns:
        Their rows of ``netem_packet``, sequence numbers and event times.
    """
    headers = np.ascontiguousarray(packets["head"]).view(HEADER_ROW)
    mine = np.logical_or.reduce([headers["version"] == version for version in VERSIONS])
    mine &= (headers["magic"] == MAGIC) & (headers["flow"] == flow) & (headers["t_ns"] >= 0)
    mine &= headers["sequence"] < 2**63  # others do not fit the record's columns
    return (
        packets.compress(mine),
        headers["sequence"].compress(mine).astype(np.int64),
        headers["t_ns"].compress(mine),
    )


GROWTH = 1000.0
_STILL_GROWING = 2.0
_LEAST_SAMPLES = 20


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


class Divergence(NamedTuple):
    """The divergence of a run."""

    at_s: float
    """First time at which the state was not finite or exceeded ``GROWTH`` times the scale."""
    text: str
    """Description in one line."""


@np.errstate(all="ignore")
def divergence(
    parts: Iterable[tuple[Vector, Matrix]], count: int, scenarios: Iterable[Scenario]
) -> Divergence | None:
    """Return the divergence of a run; None if the run did not diverge.

    Args:
        parts: times of the samples in s, (k,), ascending, and the plant's state, (k, n).
        count: number of samples in all parts.
        scenarios: the resolved scenario, and the scenarios after each change of settings.
    """
    tenth, seventh, ninth = (round(share * count) for share in (0.1, 0.7, 0.9))
    early = middle = last = highest = 0.0
    peaks: list[tuple[float, float]] = []  # each ‖x‖ above all before, with its time
    samples = 0
    for t_s, x in parts:
        lost = np.flatnonzero(~all_entries(np.isfinite(x)))
        if len(lost):
            at_s = float(t_s[lost[0]])
            return Divergence(at_s, f"diverged: x is not finite at {at_s:g} s")
        norms = row_norms(x)
        early = float(norms[: max(tenth - samples, 0)].max(initial=early))
        middle = float(norms[: max(seventh - samples, 0)].max(initial=middle))
        last = float(norms[max(ninth - samples, 0) :].max(initial=last))
        before = np.maximum.accumulate(np.append(highest, norms))
        above = np.flatnonzero(norms > before[:-1])
        peaks += zip(t_s[above].tolist(), norms[above].tolist(), strict=True)
        highest, samples = float(before[-1]), samples + len(norms)
    if count < _LEAST_SAMPLES:
        return None
    scale = max(early, *map(_scale, scenarios))
    if not scale or last <= max(GROWTH * scale, _STILL_GROWING * middle):
        return None
    at_s = next(t_s for t_s, size in peaks if size > GROWTH * scale)
    return Divergence(
        at_s,
        f"diverged: ‖x‖ passed {GROWTH * scale:.3g} ({GROWTH:g} times its expected size) at "
        f"{at_s:g} s, reached {last:.3g}, and was still growing at the end",
    )


class GrowthMonitor:
    """Finds the loops whose state leaves its scale, while they run; each loop is found once.

    Whether it then keeps growing, as :func:`divergence` asks, is known at the end only.

    Args:
        loops: the resolved scenario of each loop.
    """

    def __init__(self, loops: Sequence[Scenario]) -> None:
        self._early_ns = loops[0].timing.horizon_ns // 10
        self._scales = np.array([_scale(loop) for loop in loops])
        self._found = np.zeros(len(loops), np.bool_)
        sizes = np.array([loop.model.dimensions[0] for loop in loops])
        self._entries = np.arange(sizes.max()) < sizes[:, None]
        """(loops, n) which entries of a vector each loop has."""

    @np.errstate(all="ignore")
    def take(
        self, loops: NDArray[np.integer], t_ns: NDArray[np.int64], x: Matrix
    ) -> list[tuple[int, int, str]]:
        """Add states x, (k, n), of loops, (k,), at their times; return loop, time and text.

        Of a loop with fewer states than n, the others are not used.
        """
        norms = row_norms(np.where(self._entries[loops], x, 0.0))
        lost, early = ~np.isfinite(norms), t_ns < self._early_ns
        np.fmax.at(self._scales, loops[early & ~lost], norms[early & ~lost])
        limits = GROWTH * self._scales[loops]
        beyond = np.flatnonzero(lost | (~early & (limits > 0) & (norms > limits)))
        new = []
        for row in beyond[~self._found[loops[beyond]]].tolist():
            if self._found[loop := int(loops[row])]:
                continue
            self._found[loop] = True
            passed = f"‖x‖ passed {limits[row]:.3g} ({GROWTH:g} times its expected size)"
            text = "x is not finite" if lost[row] else passed
            new.append((loop, int(t_ns[row]), text))
        return new


def _scale(scenario: Scenario) -> float:
    """Return the magnitude of ‖x‖ to expect from a scenario's disturbances and set-point."""
    loop = loop_of(scenario)
    carried = 0.0
    for disturbance in scenario.plant.disturbances:
        if isinstance(disturbance, StepDisturbance):
            push = (
                loop.B @ np.array(disturbance.amplitude)
                if disturbance.at == "input"
                else disturbance.amplitude
            )
            until_s = min(disturbance.until_s or scenario.horizon_s, scenario.horizon_s)
            carried += float(np.linalg.norm(push)) * max(until_s - disturbance.from_s, 0.0)
    setpoint = 0.0 if loop.setpoint is None else float(np.linalg.norm(loop.setpoint))
    threshold = policy_of(scenario).largest_threshold
    if loop.weight is not None:
        threshold /= float(np.linalg.svd(loop.weight, compute_uv=False)[-1])
    return max(carried, setpoint, threshold)

"""Reads the conditions of a run off its rows, as they come in or all at once.

Each process's rows come in their order, but one process's may come long after another's. What
depends on rows that are still to come waits for them. Only :meth:`ConditionReader.end` says that
there are none, and that what is not known is late. Only what waits is kept.
"""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.observed_conditions import (
    ObservedConditions,
    PacketLosses,
    SampledSeries,
)
from cosim.record.run_record import Rows, RunRecord, updates_in
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    effective,
)
from plant_server.watchdog import too_old

Times = NDArray[np.int64]
_Batches = list[tuple[NDArray[Any], ...]]
"""Columns of rows that wait, batch by batch."""

_KEPT_TICKS = 512
"""A process hands over its tables one after the other, up to 256 rows of each."""
_NEVER = 2**63 - 1
_NO_TIMES: Times = np.zeros(0, np.int64)


def read_conditions(record: RunRecord) -> ObservedConditions:
    """Read the conditions off the record of a run, complete or not: what is not known is late."""
    observer = ConditionReader(record.scenario)
    for table in record.tables:
        observer.take(table, record[table])
    return observer.end()


class ConditionReader:
    """Finds out under which conditions a run takes place.

    Args:
        scenario: the resolved scenario.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._timeout_s = scenario.timing.actuation_timeout_ns / NS_PER_S
        self._gaps = _Gaps()
        self._sensors = _Sensors()
        self._ticks = _Ticks()
        self._inputs = _Inputs(scenario)
        self._updates = _Updates()
        self._takes: Mapping[str, Callable[[Rows], None]] = {
            SENSOR_MEASUREMENT: self._measured,
            PLANT_STEP: self._inputs.steps,
            PLANT_ACTUATION: self._inputs.actuations,
            CONTROLLER_STEP: self._ticks.ticks,
            CONTROLLER_DELIVERY: self._ticks.deliveries,
            NETEM_PACKET: self._updates.packets,
        }

    def take(self, table: str, rows: Rows) -> None:
        """Take rows that follow those of the table that were taken before."""
        if len(rows) and table in self._takes:
            self._takes[table](rows)

    def observed(self) -> ObservedConditions:
        """What has been found out since it was asked for last.

        As long as the plant has not felt the controller, ``start_s`` is how far that is known.
        """
        return self._observed(None)

    def end(self) -> ObservedConditions:
        """The rest of it; no more rows come."""
        return self._observed(max(self._inputs.newest_ns, self._gaps.newest_ns))

    @property
    def waiting(self) -> int:
        """How many things wait for rows that are still to come."""
        return self._inputs.waiting + self._ticks.waiting + self._updates.waiting

    def _measured(self, rows: Rows) -> None:
        self._gaps.measurements(rows["t_ns"])
        self._sensors.measurements(rows["input"] // GENERATION, rows["t_ns"])
        events = rows[rows["event"] != NO_SEQUENCE]
        self._updates.events(events["event"], events["t_ns"])

    def _observed(self, end_ns: int | None) -> ObservedConditions:
        ended = end_ns is not None
        self._inputs.learn(self._ticks.told(ended=ended), self._ticks.newest, ended=ended)
        hold, watchdog, safe_input = self._inputs.judged(ended=ended)
        self._updates.deliveries(self._inputs.applied_input(ended=ended))
        start_s = self._inputs.start_ns * 1e-9 if self._inputs.started else np.inf
        losses, delay = self._updates.resolved(start_s, end_ns)
        if not self._inputs.started and not ended:
            start_s = self._inputs.judged_ns * 1e-9
        return ObservedConditions(
            losses, self._gaps.gaps(end_ns), delay, hold, start_s, watchdog, safe_input,
            self._sensors.restarts(), self._timeout_s,
        )  # fmt: skip


class _Gaps:
    """Times between measurements, from the start and to the end, too."""

    def __init__(self) -> None:
        self._times: list[Times] = []
        self.newest_ns = 0

    def measurements(self, t_ns: Times) -> None:
        self._times.append(np.append(self.newest_ns, t_ns))
        self.newest_ns = int(t_ns[-1])

    def gaps(self, end_ns: int | None) -> SampledSeries:
        times = [*self._times]
        if end_ns is not None:
            times.append(np.array([self.newest_ns, end_ns]))
        self._times = []
        since_ns = np.concatenate([_NO_TIMES, *(t_ns[:-1] for t_ns in times)])
        gaps_ns = np.concatenate([_NO_TIMES, *map(np.diff, times)])
        kept = gaps_ns > 0
        return SampledSeries(since_ns[kept] * 1e-9, gaps_ns[kept] * 1e-9)


class _Sensors:
    """When a sensor took another's place."""

    def __init__(self) -> None:
        self._newest = 0
        self._found: _Batches = []

    def measurements(self, of: Times, t_ns: Times) -> None:
        first = np.flatnonzero(np.diff(of, prepend=self._newest) > 0)
        self._newest = int(of[-1])
        if len(first):
            self._found.append((t_ns[first], of[first]))

    def restarts(self) -> SampledSeries:
        t_ns, of = _columns(self._found, 2)
        self._found = []
        return SampledSeries(t_ns * 1e-9, of * 1.0)


class _Told(NamedTuple):
    """Updates that the controller took."""

    sequence: Times
    model_ns: Times
    """When its model had it."""
    tick: Times
    """The first tick that knew of it."""


class _Ticks:
    """Finds the tick that first knew of each update."""

    def __init__(self) -> None:
        self._ticks: _Batches = []
        self._taken: _Batches = []
        self.newest = NO_SEQUENCE

    def ticks(self, rows: Rows) -> None:
        self._ticks.append((rows["input"], rows["sequence"]))
        self.newest = int(rows["sequence"][-1])

    def deliveries(self, rows: Rows) -> None:
        self._taken.append((rows["input"], rows["sequence"], rows["model_t_ns"]))

    @property
    def waiting(self) -> int:
        return sum(len(inputs) for inputs, *_ in self._taken)

    def told(self, *, ended: bool) -> _Told:
        """What became known since the last time; at the end, also what no tick knew of."""
        inputs, ticks = _columns(self._ticks, 2)
        taken, sequence, model_ns = _columns(self._taken, 3)
        first = np.searchsorted(inputs, taken, "right")
        known = len(taken) if ended else int((first < len(inputs)).sum())
        self._taken = [(taken[known:], sequence[known:], model_ns[known:])]
        self._ticks = [(inputs[-_KEPT_TICKS:], ticks[-_KEPT_TICKS:])]
        tick = np.append(ticks, _NEVER)[first[:known]]
        # What a controller took that died before its next tick, its successor does not know.
        of = taken[:known] // GENERATION
        kept = (tick == _NEVER) | (tick // GENERATION == of)
        return _Told(sequence[:known][kept], model_ns[:known][kept], tick[kept])


class _Inputs:
    """What the plant's inputs rest on, step by step."""

    def __init__(self, scenario: Scenario) -> None:
        self._period_ns = scenario.timing.plant_period_ns
        self._timeout_ns = scenario.timing.actuation_timeout_ns
        self._replaces = scenario.plant.watchdog.policy != "hold"
        known = scenario.network.initial_sync == "known_state"
        self._knowing: dict[int, int] = {0: 0} if known else {}
        """Of each generation of the controller, the first tick that knew a state."""
        self._ticked = NO_SEQUENCE
        self._steps: _Batches = []
        self._actuations: _Batches = []
        self._received = NO_SEQUENCE
        self._latched = NO_SEQUENCE
        self._latches: _Batches = []
        self._told: _Batches = []
        self.newest_ns = 0
        self.judged_ns = 0
        self.start_ns = 0
        self.started = False

    def steps(self, rows: Rows) -> None:
        with np.errstate(invalid="ignore"):
            sizes = np.abs(rows["u"]).max(axis=1)
        self._steps.append((rows["t_ns"], rows["actuation"], sizes))
        self.newest_ns = int(rows["t_ns"][-1])

    def actuations(self, rows: Rows) -> None:
        self._actuations.append((rows["sequence"], rows["t_ns"]))
        self._received = int(rows["sequence"][-1])

    @property
    def waiting(self) -> int:
        held = (self._steps, self._latches, self._told)
        return sum(len(batch[0]) for batches in held for batch in batches)

    def learn(self, told: _Told, ticked: int, *, ended: bool) -> None:
        """Take what became known of the controller: updates, and its newest tick."""
        for tick in told.tick[np.diff(told.tick // GENERATION, prepend=-1) > 0].tolist():
            self._knowing.setdefault(tick // GENERATION, tick)
        self._told.append(told)
        self._ticked = _NEVER if ended else ticked

    def judged(self, *, ended: bool) -> tuple[SampledSeries, SampledSeries, SampledSeries]:
        """Of the steps that can be judged: ages of inputs, of what the watchdog replaced, and
        sizes of safe inputs."""  # noqa: D205, D209
        t_ns, newest, sizes = _columns(self._steps, 3)
        ready = newest <= (_NEVER if ended else self._received)
        ready &= (newest <= self._ticked) | (self._knows_from(newest) < _NEVER)
        count = int(np.minimum.accumulate(ready).sum())
        self._steps = [(t_ns[count:], newest[count:], sizes[count:])]
        t_ns, newest, sizes = t_ns[:count], newest[:count], sizes[:count]
        model_ns = self._model_ns(newest)
        highest = np.maximum.accumulate(np.append(self._latched, newest))
        there = newest != NO_SEQUENCE
        feels = there & (highest[1:] >= self._knows_from(highest[1:]))
        began = np.logical_or.accumulate(np.append(self.started, feels))[:-1]
        if count:
            self.judged_ns = int(t_ns[-1])
            rises = np.diff(highest) > 0
            self._latches.append((highest[1:][rises], t_ns[rises]))
            self._latched = int(highest[-1])
        if not self.started and feels.any():
            self.started, self.start_ns = True, int(t_ns[np.argmax(feels)])
        # A plant that is late latches what is of its future.
        age_ns = np.maximum(t_ns + self._period_ns - model_ns, model_ns - t_ns)
        replaced = feels & self._replaces & too_old(t_ns, model_ns, self._timeout_ns)
        # Before the plant has felt the controller, no input is what is presupposed.
        safe = there & ~feels & (began | ~(sizes == 0))
        step_s, kept = t_ns * 1e-9, feels & ~replaced
        return (
            SampledSeries(step_s[kept], age_ns[kept] * 1e-9),
            SampledSeries(step_s[replaced], (t_ns - model_ns)[replaced] * 1e-9),
            SampledSeries(step_s[safe], sizes[safe]),
        )

    def _knows_from(self, ticks: Times) -> Times:
        """The first tick, of the same generation of the controller, that knew a state."""
        of, which = np.unique(ticks // GENERATION, return_inverse=True)
        first = [self._knowing.get(number, _NEVER) for number in of.tolist()]
        return np.array(first, dtype=np.int64)[which]

    def _model_ns(self, newest: Times) -> Times:
        """Time of the model behind each actuation; of one that is not on record, 0."""
        sequence, t_ns = _columns(self._actuations, 2)
        found = np.searchsorted(sequence, newest)
        there = np.append(sequence, NO_SEQUENCE)[found] == newest
        model_ns = np.where(there & (newest != NO_SEQUENCE), np.append(t_ns, 0)[found], 0)
        # A step that is still to come has the newest of these, or one that is still to come.
        used = int(np.searchsorted(sequence, newest[-1])) if len(newest) else 0
        self._actuations = [(sequence[used:], t_ns[used:])]
        return model_ns

    def applied_input(self, *, ended: bool) -> list[tuple[int, int, int | None]]:
        """Updates that the plant felt since the last time, in order.

        Returns:
            Sequence number, when the controller's model had it, and when the plant felt it, in ns,
            which is None if it never did.
        """
        sequence, model_ns, tick = _columns(self._told, 3)
        latched, t_ns = _columns(self._latches, 2)
        first = np.searchsorted(latched, tick)
        known = len(tick) if ended else int((first < len(latched)).sum())
        felt_ns = [int(t_ns[i]) if i < len(latched) else None for i in first[:known]]
        self._told = [(sequence[known:], model_ns[known:], tick[known:])]
        needed = latched > self._ticked  # ticks that are still to come are later than these
        self._latches = [(latched[needed], t_ns[needed])]
        numbers = zip(sequence[:known].tolist(), model_ns[:known].tolist(), felt_ns, strict=True)
        return list(numbers)


class _Updates:
    """What became of each event's update."""

    def __init__(self) -> None:
        self._events: deque[tuple[int, int]] = deque()
        self._taken: deque[tuple[int, int, int | None]] = deque()
        self._passed: dict[int, bool] = {}
        self._newest_packet = NO_SEQUENCE
        self._resolved = NO_SEQUENCE

    def events(self, sequence: Times, t_ns: Times) -> None:
        self._events.extend(zip(sequence.tolist(), t_ns.tolist(), strict=True))

    def packets(self, rows: Rows) -> None:
        rows, sequences, _ = updates_in(rows)
        for sequence, passed in zip(
            sequences.tolist(), effective(rows["fate"]).tolist(), strict=True
        ):
            self._passed[sequence] = self._passed.get(sequence, False) or passed
            self._newest_packet = max(self._newest_packet, sequence)

    def deliveries(self, applied_input: list[tuple[int, int, int | None]]) -> None:
        self._taken.extend(applied_input)

    @property
    def waiting(self) -> int:
        return len(self._events) + len(self._taken) + len(self._passed)

    def resolved(self, start_s: float, end_ns: int | None) -> tuple[PacketLosses, SampledSeries]:
        """What became of the events since the last time, in their order."""
        losses: list[tuple[int, float]] = []
        delays: list[tuple[int, int]] = []
        while self._events:
            found = self._fate(*self._events[0], end_ns)
            if found is None:
                break
            made_up_s, acts_ns = found
            self._resolved, t_ns = self._events.popleft()
            losses.append((t_ns, made_up_s))
            # What the start brings with it is the start's.
            if acts_ns is not None and acts_ns * 1e-9 > start_s:
                delays.append((t_ns, max(acts_ns - t_ns, 0)))
        for sequence in [one for one in self._passed if one <= self._resolved]:
            del self._passed[sequence]
        lost, late = np.array(losses).reshape(-1, 2), np.array(delays).reshape(-1, 2)
        return (
            PacketLosses(lost[:, 0] * 1e-9, lost[:, 1]),
            SampledSeries(late[:, 0] * 1e-9, late[:, 1] * 1e-9),
        )

    def _fate(
        self, sequence: int, event_ns: int, end_ns: int | None
    ) -> tuple[float, int | None] | None:
        """After which time a newer update made up for a lost one, and when it acted if it did.

        None if that is not known yet. An update that is under way at the end is not lost, but as
        late as it could be.
        """
        while self._taken and self._taken[0][0] < sequence:
            self._taken.popleft()
        passed = self._passed.get(sequence)
        if not self._taken:
            if passed is False:
                return np.inf, None
            return None if end_ns is None else (0.0, end_ns)
        taken, model_ns, felt_ns = self._taken[0]
        felt_ns = end_ns if felt_ns is None else felt_ns
        if taken == sequence:
            return None if felt_ns is None else (0.0, max(felt_ns, model_ns))
        if passed is None and end_ns is None and self._newest_packet < sequence:
            return None  # the network's word on it is still to come
        if not passed:
            return np.inf, None
        # Had it only been overtaken, a newer one made up for it.
        return None if felt_ns is None else ((felt_ns - event_ns) * 1e-9, None)


def _columns(batches: _Batches, count: int) -> tuple[NDArray[Any], ...]:
    """Put batches of columns one after the other."""
    if not batches:
        return (_NO_TIMES,) * count
    if len(batches) == 1:
        return batches[0]
    return tuple(np.concatenate(column) for column in zip(*batches, strict=True))

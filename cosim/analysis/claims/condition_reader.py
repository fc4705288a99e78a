"""Reads the conditions of a run from its rows: batch by batch during the run, or all at once.

The rows of one process arrive in order; those of different processes may be far apart. A row that
depends on rows of another process waits for them, and only waiting rows are kept:

* :class:`Clocks` gathers the bounds of the clocks' errors;
* :class:`Ticks` and :class:`Inputs` find out which update the controller computed each of the
  plant's inputs with: the rows of ticks, deliveries and steps of the plant wait for one another;
* :class:`ConditionReader` has all of it. Its ``end`` closes the run: updates and inputs that are
  still missing then count as late.
* :func:`read_conditions` reads a whole record; :class:`AssumptionMonitor` checks the assumptions of
  a run's claims during the run. It reports the same violations as
  :class:`~cosim.analysis.claims.claim_evaluation.ClaimEvaluation` does after the run, from the same
  limits, as soon as the rows arrive.
"""

import math
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.observed_conditions import (
    AssumptionViolation,
    ObservedConditions,
    PacketLosses,
    SampledSeries,
    causes_of,
    clock_cause,
    combined,
    lost_cause,
)
from cosim.record.run_events import updates_in
from cosim.record.run_record import Rows, RunRecord
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import largest_sizes
from noack.protocol.record_tables import (
    CLOCK_TABLES,
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    LOST_NS,
    NETEM_PACKET,
    NO_SEQUENCE,
    OWNER,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    effective,
)
from noack.protocol.roles import GENERATION, LOOP_ROLES
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import allowed_conditions
from plant_server.plant import too_old

Times = NDArray[np.int64]
Batches = list[tuple[NDArray[Any], ...]]
"""Columns of the waiting rows, batch by batch."""
NEVER = 2**63 - 1
NO_TIMES: Times = np.zeros(0, np.int64)
_KEPT_TICKS = 512
"""A process sends its tables one after the other, up to 256 rows of each."""


def columns(batches: Batches, count: int) -> tuple[NDArray[Any], ...]:
    """Concatenate batches of columns."""
    if not batches:
        return (NO_TIMES,) * count
    if len(batches) == 1:
        return batches[0]
    return tuple(np.concatenate(column) for column in zip(*batches, strict=True))


class Clocks:
    """Gathers the bounds that the processes recorded; each holds from the time of its row on."""

    def __init__(self, settings: ClocksSection) -> None:
        self._largest_s = settings.largest_error_us * 1e-6
        self._rows: defaultdict[str, Batches] = defaultdict(list)

    def add(self, role: str, rows: Rows) -> None:
        """Add rows of the table about a process's clock, in their order."""
        self._rows[role].append((np.maximum(rows["t_ns"], 0), rows["error_ns"]))

    def observed(self) -> dict[str, Any]:
        """Return what was added since the last call, as fields of ``ObservedConditions``."""
        errors: dict[str, SampledSeries] = {}
        for role in LOOP_ROLES:
            t_ns, error_ns = columns(self._rows.pop(role, []), 2)
            t_s, error_s, lost = t_ns * 1e-9, error_ns / NS_PER_S, error_ns == LOST_NS
            errors[clock_cause(role)] = SampledSeries(t_s[~lost], error_s[~lost]).in_order()
            errors[lost_cause(role)] = SampledSeries(t_s[lost], 0 * t_s[lost]).in_order()
        return {"clocks": errors, "largest_clock_error_s": self._largest_s}


class Receipts(NamedTuple):
    """Updates that the controller received, with the first tick computed with each."""

    sequence: Times
    model_ns: Times
    """Model time of the reset."""
    tick: Times


class Ticks:
    """Finds the first tick computed with each update."""

    def __init__(self) -> None:
        self._ticks: Batches = []
        self._deliveries: Batches = []
        self.newest = NO_SEQUENCE

    def ticks(self, rows: Rows) -> None:
        """Add rows of the controller's ticks."""
        self._ticks.append((rows["input"], rows["sequence"]))
        self.newest = int(rows["sequence"][-1])

    def deliveries(self, rows: Rows) -> None:
        """Add rows of updates that the controller received."""
        self._deliveries.append((rows["input"], rows["sequence"], rows["model_t_ns"]))

    @property
    def waiting(self) -> int:
        """Number of rows that wait."""
        return sum(len(inputs) for inputs, *_ in self._deliveries)

    def receipts(self, *, ended: bool) -> Receipts:
        """Return the updates whose tick was determined; at the end, also those without a tick."""
        inputs, ticks = columns(self._ticks, 2)
        received, sequence, model_ns = columns(self._deliveries, 3)
        first = np.searchsorted(inputs, received, "right")
        known = len(received) if ended else int((first < len(inputs)).sum())
        self._deliveries = [(received[known:], sequence[known:], model_ns[known:])]
        self._ticks = [(inputs[-_KEPT_TICKS:], ticks[-_KEPT_TICKS:])]
        tick = np.append(ticks, NEVER)[first[:known]]
        # If the controller died before its next tick, the restarted one does not have the update.
        of = received[:known] // GENERATION
        same = (tick == NEVER) | (tick // GENERATION == of)
        return Receipts(sequence[:known][same], model_ns[:known][same], tick[same])


class Inputs:
    """The origin of the plant's inputs, step by step."""

    def __init__(self, scenario: Scenario) -> None:
        self._period_ns = scenario.timing.plant_period_ns
        self._tick_ns = scenario.timing.controller_period_ns
        self._timeout_ns = scenario.timing.actuation_timeout_ns
        self._replaces = scenario.plant.watchdog.policy != "hold"
        known = scenario.network.initial_sync == "known_state"
        self._first_state: dict[int, int] = {0: 0} if known else {}
        """By generation of the controller: its first tick with a state."""
        self._ticked = NO_SEQUENCE
        self._steps: Batches = []
        self._actuations: Batches = []
        self._received = NO_SEQUENCE
        self._latched = NO_SEQUENCE
        self._latches: Batches = []
        self._receipts: Batches = []
        self.newest_ns = 0
        self.classified_ns = 0
        self.start_ns = 0
        self.started = False

    def steps(self, rows: Rows) -> None:
        """Add rows of the plant's steps."""
        with np.errstate(invalid="ignore"):
            sizes = largest_sizes(rows["u"])
        # The age of an input that was predicted counts from the time that it is for.
        ahead_ns = np.zeros(len(rows), np.int64)
        if "entry" in (rows.dtype.names or ()):
            ahead_ns = np.maximum(rows["entry"], 0) * self._tick_ns
        self._steps.append((rows["t_ns"], rows["actuation"], sizes, ahead_ns))
        self.newest_ns = int(rows["t_ns"][-1])

    def actuations(self, rows: Rows) -> None:
        """Add rows of actuations that the plant received."""
        self._actuations.append((rows["sequence"], rows["t_ns"]))
        self._received = int(rows["sequence"][-1])

    @property
    def waiting(self) -> int:
        """Number of rows that wait."""
        stored = (self._steps, self._latches, self._receipts)
        return sum(len(batch[0]) for batches in stored for batch in batches)

    def add_receipts(self, receipts: Receipts, ticked: int) -> None:
        """Add updates that the controller received, and the number of its newest tick."""
        ticks = receipts.tick
        for tick in ticks[np.diff(ticks // GENERATION, prepend=-1) > 0].tolist():
            self._first_state.setdefault(tick // GENERATION, tick)
        self._receipts.append(receipts)
        self._ticked = ticked

    def classified(self, *, ended: bool) -> tuple[SampledSeries, SampledSeries, SampledSeries]:
        """Classify the steps with a known input.

        Returns:
            Ages of inputs; ages of actuations that the watchdog replaced; sizes of safe inputs.
        """
        t_ns, newest, sizes, ahead_ns = columns(self._steps, 4)
        ready = newest <= (NEVER if ended else self._received)
        ready &= (newest <= self._ticked) | (self._first_with_state(newest) < NEVER)
        count = int(np.minimum.accumulate(ready).sum())
        self._steps = [(t_ns[count:], newest[count:], sizes[count:], ahead_ns[count:])]
        t_ns, newest, sizes = t_ns[:count], newest[:count], sizes[:count]
        sent_ns = self._model_ns(newest)
        model_ns = sent_ns + ahead_ns[:count]
        highest = np.maximum.accumulate(np.append(self._latched, newest))
        is_input = newest != NO_SEQUENCE
        controlled = is_input & (highest[1:] >= self._first_with_state(highest[1:]))
        began = np.logical_or.accumulate(np.append(self.started, controlled))[:-1]
        if count:
            self.classified_ns = int(t_ns[-1])
            rises = np.diff(highest) > 0
            self._latches.append((highest[1:][rises], t_ns[rises]))
            self._latched = int(highest[-1])
        if not self.started and controlled.any():
            self.started, self.start_ns = True, int(t_ns[np.argmax(controlled)])
        # A late plant step may apply an input with a model time after the step's nominal time.
        age_ns = np.maximum(t_ns + self._period_ns - model_ns, model_ns - t_ns)
        replaced = controlled & self._replaces & too_old(t_ns, sent_ns, self._timeout_ns)
        # Until the first input with a state, the certificates assume that the input is 0.
        safe = is_input & ~controlled & (began | ~(sizes == 0))
        step_s, held = t_ns * 1e-9, controlled & ~replaced
        return (
            SampledSeries(step_s[held], age_ns[held] * 1e-9),
            SampledSeries(step_s[replaced], (t_ns - sent_ns)[replaced] * 1e-9),
            SampledSeries(step_s[safe], sizes[safe]),
        )

    def _first_with_state(self, ticks: Times) -> Times:
        """The first tick with a state, of the same generation of the controller."""
        first_tick, of = np.full(len(ticks), NEVER), ticks // GENERATION
        for number, first in self._first_state.items():
            first_tick[of == number] = first
        return first_tick

    def _model_ns(self, newest: Times) -> Times:
        """Return the model time of each actuation; 0 if the actuation is not recorded."""
        sequence, t_ns = columns(self._actuations, 2)
        index = np.searchsorted(sequence, newest)
        is_recorded = np.append(sequence, NO_SEQUENCE)[index] == newest
        model_ns = np.where(is_recorded & (newest != NO_SEQUENCE), np.append(t_ns, 0)[index], 0)
        # A later step has the newest of these actuations, or a later one.
        used = int(np.searchsorted(sequence, newest[-1])) if len(newest) else 0
        self._actuations = [(sequence[used:], t_ns[used:])]
        return model_ns

    def applied(self, *, ended: bool) -> list[tuple[int, int, int | None]]:
        """Updates that took effect on the plant since the last call, in order.

        Returns:
            Sequence number; model time of the reset, ns; time of the first step with an input
            computed with the update, ns, None if there was none.
        """
        sequence, model_ns, tick = columns(self._receipts, 3)
        latched, t_ns = columns(self._latches, 2)
        first = np.searchsorted(latched, tick)
        known = len(tick) if ended else int((first < len(latched)).sum())
        applied_ns = [int(t_ns[i]) if i < len(latched) else None for i in first[:known]]
        self._receipts = [(sequence[known:], model_ns[known:], tick[known:])]
        needed = latched > self._ticked  # steps with a later actuation than these ticks
        self._latches = [(latched[needed], t_ns[needed])]
        return [*zip(sequence[:known].tolist(), model_ns[:known].tolist(), applied_ns, strict=True)]


class _Measurements:
    """Times between measurements, from the start of the run to its end; restarts of the sensor."""

    def __init__(self) -> None:
        self._times: list[Times] = []
        self._restarts: Batches = []
        self._generation = 0
        self.newest_ns = 0

    def add(self, rows: Rows) -> None:
        t_ns, of = rows["t_ns"], rows["input"] // GENERATION
        self._times.append(np.append(self.newest_ns, t_ns))
        self.newest_ns = int(t_ns[-1])
        first = np.diff(of, prepend=self._generation) > 0
        self._generation = int(of[-1])
        self._restarts.append((t_ns[first], of[first]))

    def gaps(self, end_ns: int | None) -> SampledSeries:
        times, self._times = self._times, []
        if end_ns is not None:
            times.append(np.array([self.newest_ns, end_ns]))
        since_ns = np.concatenate([NO_TIMES, *(t_ns[:-1] for t_ns in times)])
        gaps_ns = np.concatenate([NO_TIMES, *map(np.diff, times)])
        longer = gaps_ns > 0
        return SampledSeries(since_ns[longer] * 1e-9, gaps_ns[longer] * 1e-9)

    def restarts(self) -> SampledSeries:
        t_ns, of = columns(self._restarts, 2)
        self._restarts = []
        return SampledSeries(t_ns * 1e-9, of * 1.0)


class _Updates:
    """The outcome of each event's update."""

    def __init__(self) -> None:
        self._events: deque[tuple[int, int]] = deque()
        self._applied: deque[tuple[int, int, int | None]] = deque()
        self._passed: dict[int, bool] = {}
        self._newest_packet = NO_SEQUENCE
        self._resolved = NO_SEQUENCE

    def measurements(self, rows: Rows) -> None:
        events = rows.compress(rows["event"] != NO_SEQUENCE)
        self._events.extend(zip(events["event"].tolist(), events["t_ns"].tolist(), strict=True))

    def packets(self, rows: Rows) -> None:
        rows, sequences, _ = updates_in(rows)
        forwarded = effective(rows["fate"]).tolist()
        for sequence, passed in zip(sequences.tolist(), forwarded, strict=True):
            self._passed[sequence] = self._passed.get(sequence, False) or passed
            self._newest_packet = max(self._newest_packet, sequence)

    def add_applied(self, applied: list[tuple[int, int, int | None]]) -> None:
        self._applied.extend(applied)

    @property
    def waiting(self) -> int:
        return len(self._events) + len(self._applied) + len(self._passed)

    def resolved(self, start_s: float, end_ns: int | None) -> tuple[PacketLosses, SampledSeries]:
        """Losses and delays of the events that were resolved since the last call, in order."""
        losses: list[tuple[int, float]] = []
        delays: list[tuple[int, int]] = []
        while self._events:
            fate = self._fate(*self._events[0], end_ns)
            if fate is None:
                break
            replaced_s, acts_ns = fate
            self._resolved, t_ns = self._events.popleft()
            losses.append((t_ns, replaced_s))
            # A delay before the first input is part of the start.
            if acts_ns is not None and acts_ns * 1e-9 > start_s:
                delays.append((t_ns, max(acts_ns - t_ns, 0)))
        for sequence in [passed for passed in self._passed if passed <= self._resolved]:
            del self._passed[sequence]
        lost, late = np.array(losses).reshape(-1, 2), np.array(delays).reshape(-1, 2)
        return (
            PacketLosses(lost[:, 0] * 1e-9, lost[:, 1]),
            SampledSeries(late[:, 0] * 1e-9, late[:, 1] * 1e-9),
        )

    def _fate(self, sequence: int, event_ns: int, end_ns: int | None) -> tuple[float, int | None] | None:
        """Return when a newer update replaced a lost one, in s, and when the update acted, in ns.

        None if this is not determined yet. An update in flight at the end is not lost; it counts as
        delivered at the end.
        """
        while self._applied and self._applied[0][0] < sequence:
            self._applied.popleft()
        passed = self._passed.get(sequence)
        if not self._applied:
            if passed is False:
                return np.inf, None
            return None if end_ns is None else (0.0, end_ns)
        received, model_ns, applied_ns = self._applied[0]
        applied_ns = end_ns if applied_ns is None else applied_ns
        if received == sequence:
            return None if applied_ns is None else (0.0, max(applied_ns, model_ns))
        if passed is None and end_ns is None and self._newest_packet < sequence:
            return None  # its row of netem_packet has not arrived yet
        if not passed:
            return np.inf, None
        # It was delivered out of order: a newer update replaced it.
        return None if applied_ns is None else ((applied_ns - event_ns) * 1e-9, None)


READ = (
    SENSOR_MEASUREMENT,
    PLANT_STEP,
    PLANT_ACTUATION,
    CONTROLLER_STEP,
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
)
"""The tables that the conditions depend on."""
_COLUMNS = (
    "input", "sequence", "t_ns", "event", "actuation", "u", "entry", "model_t_ns", "error_ns",
    "flow", "fate", "release_ns", "copy_ns", "bit", "head",
)  # fmt: skip


class ConditionReader:
    """Determines the conditions under which a run of a resolved scenario takes place."""

    def __init__(self, scenario: Scenario) -> None:
        self._timeout_s = scenario.timing.actuation_timeout_ns / NS_PER_S
        self._measurements = _Measurements()
        self._ticks = Ticks()
        self._inputs = Inputs(scenario)
        self._updates = _Updates()
        # Methods of its parts: with one of its own, it would refer to itself.
        self._takes: Mapping[str, Sequence[Callable[[Rows], None]]] = {
            SENSOR_MEASUREMENT: (self._measurements.add, self._updates.measurements),
            PLANT_STEP: (self._inputs.steps,),
            PLANT_ACTUATION: (self._inputs.actuations,),
            CONTROLLER_STEP: (self._ticks.ticks,),
            CONTROLLER_DELIVERY: (self._ticks.deliveries,),
            NETEM_PACKET: (self._updates.packets,),
        }
        self._clocks = None if scenario.clocks is None else Clocks(scenario.clocks)

    def take(self, table: str, rows: Rows) -> None:
        """Add rows of a table, in their order."""
        if len(rows) and table in self._takes:
            for take in self._takes[table]:
                take(rows)
        elif len(rows) and self._clocks is not None and table in CLOCK_TABLES:
            self._clocks.add(OWNER[table], rows)

    def observed(self) -> ObservedConditions:
        """Return the conditions that were determined since the last call.

        Until the plant applies the first input of the controller, ``start_s`` is the latest time
        at which it is certain that there was no such input.
        """
        return self._observed(None)

    def end(self) -> ObservedConditions:
        """Return the conditions from the rows that were still waiting; no more rows follow."""
        return self._observed(max(self._inputs.newest_ns, self._measurements.newest_ns))

    @property
    def waiting(self) -> int:
        """The number of rows that wait for others."""
        return self._inputs.waiting + self._ticks.waiting + self._updates.waiting

    def _observed(self, end_ns: int | None) -> ObservedConditions:
        ended = end_ns is not None
        newest = NEVER if ended else self._ticks.newest
        self._inputs.add_receipts(self._ticks.receipts(ended=ended), newest)
        hold, watchdog, safe_input = self._inputs.classified(ended=ended)
        self._updates.add_applied(self._inputs.applied(ended=ended))
        start_s = self._inputs.start_ns * 1e-9 if self._inputs.started else np.inf
        losses, delay = self._updates.resolved(start_s, end_ns)
        if not self._inputs.started and not ended:
            start_s = self._inputs.classified_ns * 1e-9
        return ObservedConditions(
            losses,
            self._measurements.gaps(end_ns),
            delay,
            hold,
            start_s,
            watchdog,
            safe_input,
            self._measurements.restarts(),
            self._timeout_s,
            **({} if self._clocks is None else self._clocks.observed()),
        )


def read_conditions(record: RunRecord) -> ObservedConditions:
    """Read the conditions from the record of a run; missing updates and inputs count as late."""
    reader = ConditionReader(record.scenario)
    parts: list[ObservedConditions] = []
    read = [table for table in (*READ, *CLOCK_TABLES) if table in record.tables]
    for i, part in enumerate(record.slices(*read, columns=_COLUMNS)):
        if i:
            parts.append(combined([reader.observed()]))
        for table, rows in part.items():
            reader.take(table, rows)
    return combined([*parts, reader.end()])


_MOST_WAITING = 100_000
"""Largest number of rows that wait for a process without output (some minutes of a run). If there
are more, the monitor stops."""


class AssumptionMonitor:
    """Reports each assumption of a run's claims once, when the run first violates it."""

    def __init__(self, scenario: Scenario) -> None:
        self._reader = ConditionReader(scenario)
        self._conditions = allowed_conditions(scenario)
        self._causes = {*causes_of(scenario)}
        """The assumptions that the run has not violated yet."""
        self._states: dict[str, int] = {}
        """States of the rules of the guarantee."""
        self._until_s = math.inf
        self.stopped: str | None = None
        """Reason why the monitor stopped; None while it is active."""

    def take(self, table: str, rows: Rows) -> None:
        """Add rows of a table, in their order."""
        if self.stopped is None:
            self._reader.take(table, rows)

    def stop(self, why: str) -> None:
        """Stop reporting: rows are missing, so the conditions cannot be determined."""
        self.stopped = self.stopped or why

    def end_at(self, t_s: float) -> None:
        """Ignore violations after a change of settings.

        The claims after a change depend on the state at that time; they are checked after the run.
        """
        self._until_s = min(self._until_s, t_s)

    def advance(self) -> list[AssumptionViolation]:
        """Return the assumptions that were violated for the first time since the last call."""
        if self.stopped is not None:
            return []
        violations = self._new_violations(self._reader.observed())
        if self.waiting > _MOST_WAITING:
            self.stop("a process has sent no rows for too long")
        return violations

    def end(self) -> list[AssumptionViolation]:
        """Return the violations from the rows that were still waiting; no more rows follow."""
        return [] if self.stopped is not None else self._new_violations(self._reader.end())

    @property
    def waiting(self) -> int:
        """The number of rows that wait for others."""
        return self._reader.waiting

    @np.errstate(all="ignore")  # a run may diverge
    def _new_violations(self, observed: ObservedConditions) -> list[AssumptionViolation]:
        violations = observed.violations(self._conditions, self._causes, self._states)
        new = [violation for violation in violations if violation.t_s < self._until_s]
        self._causes -= {violation.cause for violation in new}
        return new

"""Reads the conditions of a run from its rows: batch by batch during the run, or all at once.

A row that depends on rows of another process waits for them (:mod:`input_origins
<cosim.analysis.claims.input_origins>`):

* :class:`ConditionReader` reads all conditions. Its ``end`` closes the run: updates and inputs that
  are still missing then count as late.
* :func:`read_conditions` reads a whole record.
"""

from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cosim.analysis.claims.input_origins import (
    NO_INPUT,
    NO_TIMES,
    Batches,
    InputOrigins,
    TickMatcher,
    Times,
    columns,
)
from cosim.analysis.claims.observed_conditions import (
    ObservedConditions,
    PacketLosses,
    SampledSeries,
    clock_cause,
    combine,
    lost_cause,
)
from cosim.record.record_source import messages_in
from cosim.record.run_record import Rows, RunRecord
from noack.core.clock import NS_PER_S
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
from noack.protocol.roles import LOOP_ROLES
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario import Scenario


class _ClockErrors:
    """Gathers the recorded bounds of the clocks' errors; each holds from ``t_ns`` of its row on."""

    def __init__(self, settings: ClocksSection) -> None:
        self.largest_s = settings.largest_error_us * 1e-6
        self._rows: defaultdict[str, Batches] = defaultdict(list)

    def add(self, role: str, rows: Rows) -> None:
        """Add rows of the table about a process's clock, in their order."""
        self._rows[role].append((np.maximum(rows["t_ns"], 0), rows["error_ns"]))

    def take(self) -> dict[str, SampledSeries]:
        """Return what was added since the last call, by the name of the assumption."""
        errors: dict[str, SampledSeries] = {}
        for role in LOOP_ROLES:
            t_ns, error_ns = columns(self._rows.pop(role, []), 2)
            t_s, error_s, lost = t_ns * 1e-9, error_ns / NS_PER_S, error_ns == LOST_NS
            errors[clock_cause(role)] = SampledSeries(t_s[~lost], error_s[~lost]).in_order()
            errors[lost_cause(role)] = SampledSeries(t_s[lost], 0 * t_s[lost]).in_order()
        return errors


class _Measurements:
    """Times between measurements, from the start of the run to its end."""

    def __init__(self) -> None:
        self._times: list[Times] = []
        self.newest_ns = 0

    def add(self, rows: Rows) -> None:
        """Add measurements, in their order."""
        t_ns = rows["t_ns"]
        self._times.append(np.append(self.newest_ns, t_ns))
        self.newest_ns = int(t_ns[-1])

    def gaps(self, end_ns: int | None) -> SampledSeries:
        """Return the times between measurements since the last call, with the end of the run if given."""
        times, self._times = self._times, []
        if end_ns is not None:
            times.append(np.array([self.newest_ns, end_ns]))
        since_ns = np.concatenate([NO_TIMES, *(t_ns[:-1] for t_ns in times)])
        gaps_ns = np.concatenate([NO_TIMES, *map(np.diff, times)])
        longer = gaps_ns > 0
        return SampledSeries(since_ns[longer] * 1e-9, gaps_ns[longer] * 1e-9)


class _Updates:
    """The outcome of each event's update."""

    def __init__(self) -> None:
        self._events: deque[tuple[int, int]] = deque()
        self._applied: deque[tuple[int, int, int | None]] = deque()
        self._early: list[tuple[int, int]] = []
        self._passed: dict[int, bool] = {}
        self._newest_packet = NO_SEQUENCE
        self._resolved = NO_SEQUENCE

    def add_measurements(self, rows: Rows) -> None:
        """Add measurements, of which the events have updates."""
        events = rows.compress(rows["event"] != NO_SEQUENCE)
        self._events.extend(zip(events["event"].tolist(), events["t_ns"].tolist(), strict=True))

    def add_packets(self, rows: Rows) -> None:
        """Add packets at the emulator, of which the updates show whether they passed."""
        rows, sequences, _ = messages_in(rows)
        forwarded = effective(rows["fate"]).tolist()
        for sequence, passed in zip(sequences.tolist(), forwarded, strict=True):
            self._passed[sequence] = self._passed.get(sequence, False) or passed
            self._newest_packet = max(self._newest_packet, sequence)

    def add_applied(self, applied: list[tuple[int, int, int | None]]) -> None:
        """Add updates: number, model time of the reset, time at which the plant applied it, or None."""
        self._applied.extend(applied)
        times = [(applied_ns, model_ns) for _, model_ns, applied_ns in applied if applied_ns is not None]
        self._early += [(applied_ns, model_ns) for applied_ns, model_ns in times if applied_ns < model_ns]

    @property
    def waiting(self) -> int:
        """Number of entries that wait for others."""
        return len(self._events) + len(self._applied) + len(self._passed)

    def take_resolved(self, start_s: float, end_ns: int | None) -> tuple[PacketLosses, SampledSeries]:
        """Return losses and delays of the events that were resolved since the last call, in order."""
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

    def take_early(self) -> SampledSeries:
        """Return the updates that acted before the model time of their reset, since the last call."""
        early = np.array(self._early).reshape(-1, 2) * 1e-9
        self._early = []
        return SampledSeries(early[:, 0], early[:, 1])

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
        self._ticks = TickMatcher()
        self._inputs = InputOrigins(scenario)
        self._updates = _Updates()
        # Methods of its parts: with one of its own, it would refer to itself.
        self._takes: Mapping[str, Sequence[Callable[[Rows], None]]] = {
            SENSOR_MEASUREMENT: (self._measurements.add, self._updates.add_measurements),
            PLANT_STEP: (self._inputs.add_steps,),
            PLANT_ACTUATION: (self._inputs.add_actuations,),
            CONTROLLER_STEP: (self._ticks.add_ticks,),
            CONTROLLER_DELIVERY: (self._ticks.add_deliveries,),
            NETEM_PACKET: (self._updates.add_packets,),
        }
        self._clocks = None if scenario.clocks is None else _ClockErrors(scenario.clocks)

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
        newest = NO_INPUT if ended else self._ticks.newest
        self._inputs.add_receipts(self._ticks.take_receipts(ended=ended), newest)
        hold, watchdog, safe_input = self._inputs.take_inputs(ended=ended)
        self._updates.add_applied(self._inputs.take_applied(ended=ended))
        start_s = self._inputs.start_ns * 1e-9 if self._inputs.started else np.inf
        losses, delay = self._updates.take_resolved(start_s, end_ns)
        if not self._inputs.started and not ended:
            start_s = self._inputs.classified_ns * 1e-9
        return ObservedConditions(
            losses=losses,
            sampling=self._measurements.gaps(end_ns),
            delay=delay,
            hold=hold,
            start_s=start_s,
            watchdog=watchdog,
            safe_input=safe_input,
            timeout_s=self._timeout_s,
            clocks={} if self._clocks is None else self._clocks.take(),
            largest_clock_error_s=np.inf if self._clocks is None else self._clocks.largest_s,
            reached_s=np.inf if end_ns is None else end_ns * 1e-9,
            early=self._updates.take_early(),
        )


def read_conditions(record: RunRecord) -> ObservedConditions:
    """Read the conditions from the record of a run; missing updates and inputs count as late."""
    reader = ConditionReader(record.scenario)
    parts: list[ObservedConditions] = []
    read = [table for table in (*READ, *CLOCK_TABLES) if table in record.tables]
    for i, part in enumerate(record.slices(*read, columns=_COLUMNS)):
        if i:
            parts.append(combine([reader.observed()]))
        for table, rows in part.items():
            reader.take(table, rows)
    return combine([*parts, reader.end()])

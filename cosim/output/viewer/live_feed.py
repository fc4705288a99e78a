"""Feeds the recording of a run while it goes on; several loops are thinned so that a viewer keeps up.

The loops that are shown in detail have a feed each, and share a part of the recorder's time. All
loops together are shown as in the finished recording: largest values in intervals of the run. What
the viewer does not get is in the record all the same. Certified bounds, which take long to compute,
are in the finished recording only.
"""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.loops_over_time import INTERVALS, add_link_bytes, empty_over_time, intervals_of
from cosim.analysis.summary.run_summary import counts_inside, times_inside
from cosim.output.viewer.loop_feed import LAG_S, SHOWN_TABLES, LoopFeed, log_level
from cosim.output.viewer.run_recording import ALL_ERRORS, ALL_SIZES, RunRecording
from cosim.record.align import Reals
from cosim.record.rows import Rows, rows_by_loop
from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.packet_rows import NETEM_PACKET
from netem.core.row_operations import row_norms
from noack.core.linear_systems import Propagator
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, LOOP, SENSOR_MEASUREMENT
from noack.scenario.resolution import ResolvedRun, loop_of, tables_of

_TURN_S, _CORE_SHARE = 0.03, 0.3
"""CPU time of a turn; share of a core that all turns take."""
_WARNED_LAG_S, _LONGEST_LAG_S = 3.0, 10.0
"""Wall time by which the loops in detail may lag before a warning, and before they are dropped."""
_MAP_EVERY_S = 2.0
"""Wall time between two pictures of the map."""
_LONGEST_NS = 2**50
"""Longer than any run; 2**13 loops have keys of 63 bits."""
Numbers = NDArray[np.int64]


class LiveFeed:
    """Passes the rows of a run to its recording.

    Args:
        run: the run.
        view: the recording.
        warn: called with a line about what is not shown.
    """

    def __init__(self, run: ResolvedRun, view: RunRecording, warn: Callable[[str], None]) -> None:
        self._view, self._warn = view, warn
        self._wall_ns = NS_PER_S * run.scenario.speed
        self._phases_ns, self._types = run.phases_ns, [tables_of(loop) for loop in run.loops]
        self._all_loops = _AllLoops(run, view) if view.is_shared else None
        self._feeds = {
            number: LoopFeed(run.loops[number], loop_view, certified=not view.is_shared)
            for number, loop_view in view.views.items()
        }
        self._waiting: dict[str, list[Rows]] = {}
        self._due: list[int] = []
        self._round_ns = self._shown_ns = 0
        self._has_warned, self._next_s = False, 0.0

    def add(self, table: str, rows: Rows) -> None:
        """Add rows that follow the previously added ones."""
        if self._all_loops is not None:
            self._all_loops.add(table, rows)
        if self._feeds and table in SHOWN_TABLES and len(rows):
            self._waiting.setdefault(table, []).append(rows)

    def log(self, notice: Mapping[str, Any]) -> None:
        """Add a line of the run's log, with the name of its loop; also to that of the loop."""
        loop, text, t_ns = notice.get(LOOP), str(notice["text"]), int(notice["t_ns"])
        if self._all_loops is None:
            self._feeds[0].log(notice)
            return
        if loop is not None and loop < len(self._view.names):
            text, t_ns = f"{self._view.names[loop]}: {text}", t_ns + self._phases_ns[loop]
            if loop in self._feeds:
                self._feeds[loop].log(notice)
        self._view.log(t_ns, log_level(notice), text)

    def advance(self, *, final: bool = False) -> None:
        """Pass on what is complete, as far as there is time; at the end, everything.

        The recording of a single loop is that of the run: all of it is passed on.
        """
        if self._all_loops is None:
            self._begin_round()
            self._feeds[0].advance(final=final)
            self._view.flush()
            return
        if not final:
            self._watch_lag(self._all_loops.newest_ns)
            if time.monotonic() < self._next_s:
                return
        began_s = time.thread_time()
        self._all_loops.advance(final=final)
        if final:
            self._begin_round()
        while self._due or not final:
            if not self._due:
                self._begin_round()
            if not self._due:
                break
            self._feeds[self._due.pop(0)].advance(final=final)
            if not self._due:
                self._shown_ns = self._round_ns
            if not final and (not self._due or time.thread_time() - began_s > _TURN_S):
                break
        self._view.flush()
        self._next_s = time.monotonic() + (time.thread_time() - began_s) * (1 / _CORE_SHARE - 1)

    def _begin_round(self) -> None:
        """Begin a round: give each loop its rows."""
        waiting, self._waiting = self._waiting, {}
        for table, batches in waiting.items():
            for loop, rows in rows_by_loop(table, np.concatenate(batches), self._phases_ns, self._types):
                if loop in self._feeds:
                    self._feeds[loop].add(table, rows)
        self._due = [*self._feeds]
        if self._all_loops is not None:
            self._round_ns = self._all_loops.newest_ns

    def _watch_lag(self, newest_ns: int) -> None:
        """Warn of a lag of the loops in detail; give them up if it grows."""
        lag_s = (newest_ns - self._shown_ns) / self._wall_ns
        if not self._feeds or lag_s < _WARNED_LAG_S:
            return
        if lag_s > _LONGEST_LAG_S:
            self._feeds, self._due, self._waiting = {}, [], {}
            self._warn(
                f"live view: the loops in detail end here, they were {lag_s:.0f} s late; all loops "
                "together go on, and the record is complete"
            )
        elif not self._has_warned:
            self._has_warned = True
            self._warn(f"live view: the loops in detail are {lag_s:.1f} s late")


class _AllLoops:
    """Shows the norms and shares of all loops, and the network, interval by interval."""

    def __init__(self, run: ResolvedRun, view: RunRecording) -> None:
        scenario, loops = run.scenario, run.loops
        self._view, self._horizon_ns = view, scenario.timing.horizon_ns
        self._periods_ns = np.array([loop.timing.controller_period_ns for loop in loops])
        self._loops = [loop_of(loop) for loop in loops]
        sizes = np.array([loop.n for loop in self._loops])
        self._entries = np.arange(sizes.max()) < sizes[:, None]
        """(loops, n) which entries of a vector each loop has; the others are 0 here."""
        self._transitions: dict[int, Reals] = {}
        self._lag_ns = int(LAG_S * NS_PER_S * scenario.speed)
        self._phases_ns = np.array(run.phases_ns)
        numbers = [(name, "<i8") for name in (LOOP, "input", "t_ns")]
        self._no_rows = np.zeros(0, [*numbers, ("x", "<f8", (sizes.max(),))])
        self._newest = self._no_rows
        """Of each loop, the newest row of the controller that was used."""
        self._measurements: list[Rows] = []
        self._models: list[Rows] = []
        knows_state = loops[0].network.initial_sync == "known_state"
        self._first_ns = np.full(len(loops), -1 if knows_state else NEVER_NS)
        """When each loop's controller received its first state."""
        self._over_time = empty_over_time(len(loops), scenario.horizon_s)
        self._inside = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._intervals_sent = self._shares_sent = 0
        self._map_s = 0.0
        self.newest_ns = 0

    def add(self, table: str, rows: Rows) -> None:
        """Add rows."""
        if table == NETEM_PACKET:
            add_link_bytes(self._over_time.link_bytes, rows, self._horizon_ns)
            begin_ns, end_ns = map(np.concatenate, zip(self._inside, times_inside(rows), strict=True))
            self._inside = begin_ns, end_ns
        elif table == SENSOR_MEASUREMENT:
            self._measurements.append(self._needed_columns(rows, "t_ns", "x"))
            of_run_ns = rows["t_ns"] + self._phases_ns[rows[LOOP]]
            self.newest_ns = max(self.newest_ns, int(of_run_ns.max()))
        elif table in (CONTROLLER_STEP, CONTROLLER_DELIVERY):
            self._models.append(self._needed_columns(rows, "model_t_ns", "x_c"))
            if table == CONTROLLER_DELIVERY:
                of_run_ns = rows["model_t_ns"] + self._phases_ns[rows[LOOP]]
                np.minimum.at(self._first_ns, rows[LOOP], of_run_ns)

    @np.errstate(all="ignore")  # a loop may diverge
    def advance(self, *, final: bool) -> None:
        """Show the intervals that are complete."""
        until_ns = self._horizon_ns if final else self.newest_ns - self._lag_ns
        self._add_norms(until_ns)
        complete = min(max(until_ns, 0) * INTERVALS // self._horizon_ns, INTERVALS)
        if complete == self._intervals_sent:
            return
        new, self._intervals_sent = slice(self._intervals_sent, complete), complete
        middles_ns = (self._over_time.middles_s[new] * NS_PER_S).astype(np.int64)
        self._view.add_norms(ALL_ERRORS, middles_ns, self._over_time.errors[:, new])
        self._view.add_norms(ALL_SIZES, middles_ns, self._over_time.states[:, new])
        edges_ns = self._over_time.edges_s[new.start : complete + 1] * NS_PER_S
        means, largest = counts_inside(*self._inside, edges_ns)
        self._view.add_queue(middles_ns, largest, means)
        stays = self._inside[1] > edges_ns[-1]
        self._inside = self._inside[0][stays], self._inside[1][stays]
        ends_s, shares = self._over_time.shares()
        shares_known = int((ends_s <= self._over_time.edges_s[complete]).sum())
        if shares_known > self._shares_sent:
            fresh, self._shares_sent = slice(self._shares_sent, shares_known), shares_known
            t_ns = ((ends_s - ends_s[0] / 2) * NS_PER_S).astype(np.int64)
            self._view.add_shares(t_ns[fresh], shares[:, fresh])
        if not self._view.views and (final or time.monotonic() - self._map_s > _MAP_EVERY_S):
            self._view.add_map(self._over_time.errors, int(middles_ns[-1]))
            self._map_s = time.monotonic()

    def _add_norms(self, until_ns: int) -> None:
        """Add the norms of the measurements up to a time of the run."""
        measurements, at_ns = self._take(self._measurements, until_ns)
        self._raise_largest(self._over_time.states, measurements[LOOP], at_ns, row_norms(measurements["x"]))
        # x_c at each measurement follows from the newest row of the controller before it.
        models = np.append(self._newest, self._take(self._models, until_ns)[0])
        models = models[np.lexsort((models["input"], models["t_ns"], models[LOOP]))]
        _, from_end = np.unique(models[LOOP][::-1], return_index=True)
        self._newest = models[len(models) - 1 - from_end]
        keys, measurement_keys = _keys(models), _keys(measurements)
        row = np.searchsorted(keys, measurement_keys, "right") - 1
        age_ns = measurement_keys - keys[row] if len(keys) else measurement_keys
        known = (row >= 0) & (age_ns >= 0) & (age_ns <= self._periods_ns[measurements[LOOP]])
        known &= at_ns >= self._first_ns[measurements[LOOP]]
        measurements, age_ns, x_c = measurements[known], age_ns[known], models["x"][row[known]]
        for dt_ns in np.unique(age_ns).tolist():
            has_age = age_ns == dt_ns
            x_c[has_age] = self._propagate(dt_ns, measurements[has_age], x_c[has_age])
        errors = row_norms(x_c - measurements["x"])
        self._raise_largest(self._over_time.errors, measurements[LOOP], at_ns[known], errors)

    def _propagate(self, dt_ns: int, measurements: Rows, x_c: Reals) -> Reals:
        """Return models of controllers, (k, n), to measurements, by the references of the start."""
        loops = measurements[LOOP]
        if dt_ns not in self._transitions:
            transitions = np.zeros((*self._entries.shape, self._entries.shape[1]))
            for matrix, loop in zip(transitions, self._loops, strict=True):
                matrix[: loop.n, : loop.n] = Propagator(loop.H).transition(dt_ns)
            self._transitions[dt_ns] = transitions
        before, then = (self._references(loops, measurements["t_ns"] - age_ns) for age_ns in (dt_ns, 0))
        deviations: Reals = np.einsum("kij,kj->ki", self._transitions[dt_ns][loops], x_c - before)
        return then + deviations

    def _references(self, loops: Numbers, t_ns: Numbers) -> Reals:
        """Return x_r of loops at their own times, (k, n)."""
        points = np.zeros((len(loops), self._entries.shape[1]))
        for number in np.unique(loops):
            if (reference := self._loops[number].reference) is not None:
                points[loops == number, : reference.n] = reference.states(t_ns[loops == number])
        return points

    def _raise_largest(self, values: Reals, loops: Numbers, t_ns: Numbers, norms: Reals) -> None:
        """Enter norms into the largest values of their loops and intervals."""
        np.fmax.at(values, (loops, intervals_of(t_ns, self._horizon_ns)), norms)

    def _take(self, waiting: list[Rows], until_ns: int) -> tuple[Rows, Numbers]:
        """Return the waiting rows up to a time of the run, and their times of the run."""
        rows = np.concatenate([self._no_rows, *waiting])
        of_run_ns = rows["t_ns"] + self._phases_ns[rows[LOOP]]
        ready = of_run_ns <= until_ns
        waiting[:] = [rows[~ready]]
        return rows[ready], of_run_ns[ready]

    def _needed_columns(self, rows: Rows, time_name: str, vector_name: str) -> Rows:
        """Return the needed columns of rows."""
        columns = np.empty(len(rows), self._no_rows.dtype)
        loops: Numbers = rows[LOOP]
        vectors: Reals = rows[vector_name]
        columns[LOOP], columns["input"], columns["t_ns"] = loops, rows["input"], rows[time_name]
        columns["x"] = np.where(self._entries[loops], vectors, 0.0)
        return columns


def _keys(rows: Rows) -> Numbers:
    """Return keys that order rows by their loops, then by their times."""
    keys: Numbers = rows[LOOP] * _LONGEST_NS + rows["t_ns"]
    return keys

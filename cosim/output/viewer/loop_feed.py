"""Feeds the recording of a loop from its tables, as they grow or all at once."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims import run_certificates
from cosim.output.viewer.loop_recording import LoopView
from cosim.output.viewer.pictures.picture import Frames
from cosim.record.align import (
    AlignedRun,
    ControllerTrack,
    Reals,
    Times,
    align_measurements,
    controller_track,
    initial_track,
    shares_update,
    true_states,
)
from cosim.record.decimation import decimate_all
from cosim.record.rows import Rows, concatenate_rows, messages_in
from cosim.record.run_events import claimed_until_s, model_flow
from netem.core.clock import NS_PER_S
from netem.core.packet_rows import NETEM_PACKET, Fate, effective
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_SETTING,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.runtime.host_clocks import CLOCK_NOTICE
from noack.scenario.resolution import loop_of, policy_of, tables_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.coverage import is_papers_loop
from noack.theory.paper import ErrorMonitor

LAG_S = 0.2
"""Wall time by which the view lags, so that the batches of all processes have arrived."""
_PATIENCE_S = 1.0
"""Maximum wall time to wait for a controller that sends no rows."""

SHOWN_TABLES = (
    CONTROLLER_STEP,
    CONTROLLER_DELIVERY,
    CONTROLLER_SETTING,
    NETEM_PACKET,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)

_WARNINGS = ("failed", "violation", "watchdog", CLOCK_NOTICE)


def log_level(notice: Mapping[str, object]) -> str:
    """Return the viewer's level of a line of the run's log."""
    return "WARN" if notice["level"] in _WARNINGS else "INFO"


class LoopFeed:
    """Aligns growing tables and passes complete batches to the view.

    Args:
        scenario: the resolved scenario.
        view: receives the aligned batches.
        columns: number of columns of extremes to which each batch is reduced; None keeps all rows.
        certified: show the certified bounds, which take up to some seconds to compute.
    """

    def __init__(
        self,
        scenario: Scenario,
        view: LoopView,
        columns: int | None = None,
        *,
        certified: bool = True,
    ) -> None:
        self._columns = columns
        self._is_certified = certified and is_papers_loop(scenario)
        self._scenario = scenario
        self._loop = loop_of(scenario)
        self._view = view
        self._outputs = scenario.loop_outputs() if scenario.outputs else ()
        # Other tables are not shown.
        self._types = tables_of(scenario)
        self._pending: dict[str, list[Rows]] = {table: [] for table in SHOWN_TABLES}
        self._track: ControllerTrack = initial_track(scenario)
        self._undrawn: list[Rows] = []
        self._forced: set[int] = set()
        shortest_ns = scenario.timing.measurement_period.lengths_ns[0]
        self._monitor = ErrorMonitor(self._loop.H, policy_of(scenario), shortest_ns)
        # Plant steps whose x or z is shown with the measurements at their times.
        self._steps = np.zeros(0, self._types[PLANT_STEP])
        self._has_internal_state = "z" in (self._steps.dtype.names or ())
        self._settings = np.zeros(0, self._types[CONTROLLER_SETTING])
        self._flow = model_flow(scenario, self._settings)
        self._claimed_until_s = np.inf
        self._last_event_ns: int | None = None
        self._last_delivery_ns: int | None = None

    def add(self, table: str, rows: Rows) -> None:
        """Add rows that follow the previously added ones."""
        if table in self._pending and len(rows):
            self._pending[table].append(rows)

    def log(self, notice: Mapping[str, Any]) -> None:
        """Add a line of the run's log."""
        text = f"{notice['process']}: {notice['text']}" if "process" in notice else notice["text"]
        self._view.log(int(notice["t_ns"]), log_level(notice), str(text))

    @np.errstate(all="ignore")  # a run may diverge
    def advance(self, *, final: bool = False) -> None:
        """Pass on the complete batches; at the end, everything."""
        if len(settings := self._take(CONTROLLER_SETTING, None)):
            self._settings = np.concatenate([self._settings, settings])
            self._flow = model_flow(self._scenario, self._settings)
            self._claimed_until_s = claimed_until_s(self._settings)
        steps = self._take(CONTROLLER_STEP, None)
        deliveries = self._take(CONTROLLER_DELIVERY, None)
        if len(steps) or len(deliveries):
            self._track = controller_track(self._track, steps, deliveries)
        reach_ns = int(self._track.model_ns[-1])
        if final:
            until_ns = None
            reach_ns += self._scenario.timing.controller_period_ns
        else:
            waiting = self._pending[SENSOR_MEASUREMENT]
            newest_ns = int(waiting[-1]["t_ns"][-1]) if waiting else reach_ns
            wall_ns = NS_PER_S * self._scenario.speed
            until_ns = max(reach_ns, newest_ns - int(_PATIENCE_S * wall_ns))
            until_ns -= int(LAG_S * wall_ns)
        self._show_packets(self._take(NETEM_PACKET, None))
        self._view.animate_packets(self._scenario.timing.horizon_ns if until_ns is None else until_ns)
        self._show_inputs(steps)
        self._undrawn.append(deliveries)
        self._show_deliveries(until_ns)
        plant_rows = self._take(PLANT_STEP, None)
        if self._has_internal_state or not self._scenario.coverage.knows_state:
            self._steps = concatenate_rows([self._steps, plant_rows], self._steps.dtype)
        self._show_lateness("plant", plant_rows)
        self._show_measurements(self._take(SENSOR_MEASUREMENT, until_ns), reach_ns)

    def _take(self, table: str, until_ns: int | None) -> Rows:
        """Return the waiting rows of a table up to a time; they wait no longer."""
        waiting = self._pending[table]
        rows = concatenate_rows(waiting, self._types[table])
        if until_ns is None:
            self._pending[table] = []
            return rows
        ready = int(np.searchsorted(rows["t_ns"], until_ns, side="right"))
        self._pending[table] = [rows[ready:]] if ready < len(rows) else []
        return rows[:ready]

    def _show_measurements(self, rows: Rows, reach_ns: int) -> None:
        if not len(rows):
            return
        acknowledged = self._scenario.protocol.acknowledges
        aligned = align_measurements(
            self._loop, rows, self._track, reach_ns, flow=self._flow, acknowledged=acknowledged
        )
        # If the sensor does not measure x exactly, the plant's own x is shown.
        if not self._scenario.coverage.knows_state:
            aligned = aligned._replace(x=true_states(self._steps, aligned.t_ns))
        z = true_states(self._steps, aligned.t_ns, "z") if self._has_internal_state else None
        self._steps = self._steps[self._steps["t_ns"] > aligned.t_ns[-1]]
        t_s = np.asarray(aligned.t_ns * 1e-9)
        bounds = np.column_stack(
            [self._identity_bound(rows, aligned), self._certified_bound(t_s, "controller_error")]
        )
        if not self._scenario.protocol.acknowledges:
            bounds[~shares_update(self._scenario, aligned)] = np.nan
        curves = [aligned.x, aligned.x_s, aligned.x_c, aligned.e_s_norm, aligned.e_c_norm, bounds]
        kept = self._rows_to_show(aligned.t_ns, np.column_stack(curves))
        thin = AlignedRun._make(values[kept] for values in aligned)
        of_state = self._certified_bound(t_s, "state")
        of_outputs = np.array([self._certified_bound(t_s, "state", i) for i in range(len(self._outputs))])
        self._view.add_samples(thin, bounds[kept], of_state[kept], of_outputs.reshape(-1, len(t_s)).T[kept])
        frames = Frames(t_s, aligned.x, aligned.x_s, aligned.x_c, z)
        shown = self._frames_to_show(len(t_s))
        self._view.add_frames(aligned.t_ns[shown], frames.at(shown))
        keep = max(int(np.searchsorted(self._track.model_ns, rows["t_ns"][-1], "right")) - 1, 0)
        self._track = self._track.since(keep)
        self._show_events(rows["t_ns"][rows["event"] != NO_SEQUENCE])
        self._show_lateness("sensor", rows)

    def _show_events(self, event_ns: Times) -> None:
        if len(event_ns):
            passed_s = _intervals_s(event_ns, self._last_event_ns)
            keep = self._rows_to_show(event_ns, passed_s)
            self._view.add_transmissions(event_ns[keep], passed_s[keep])
            self._last_event_ns = int(event_ns[-1])

    @cached_property
    def _certificate(self) -> ScenarioCertificate | None:
        """The run's certificate; None if there is none. Computed at first use, since it is slow."""
        if not self._is_certified or self._loop.reference is not None or self._loop.loads:
            return None  # with a reference or loads, it bounds the deviations from it
        certificate = run_certificates.scheduled_certificates(self._scenario)[
            0
        ].certificate  # without a search
        if certificate.inter_event_s is not None:
            self._view.add_certified_interval(certificate.inter_event_s, self._scenario.timing.horizon_ns)
        return certificate

    def _certified_bound(
        self, t_s: Reals, quantity: Literal["controller_error", "state"], output: int | None = None
    ) -> Reals:
        """Return the certified bound of an error, of ‖x‖, or of an output by its number, (k,); or NaN."""
        certificate = self._certificate
        if certificate is None:
            return np.full(len(t_s), np.nan)
        if output is not None:
            certificate = certificate.of_output(output, self._outputs[output].row)
        bound = getattr(certificate, quantity)(t_s)
        return np.asarray(np.where(t_s < self._claimed_until_s, bound, np.nan))

    def _identity_bound(self, rows: Rows, aligned: AlignedRun) -> Reals:
        """Return the bound of ‖e_c‖ from (I1), (k,); NaN if updates are acknowledged."""
        if self._scenario.protocol.acknowledges:
            return np.full(len(rows), np.nan)
        e_s = rows["x_s"] - rows["x"]
        return self._monitor.take(rows["t_ns"], e_s, rows["event"], aligned.received).identity

    def _rows_to_show(self, t_ns: Times, values: Reals) -> NDArray[np.intp]:
        """Return the rows to show of curves, (k,) or (k, n)."""
        if self._columns is None:
            return np.arange(len(t_ns))
        t_s = np.asarray(t_ns * 1e-9, np.float64)
        return decimate_all(t_s, values.reshape(len(t_ns), -1), self._columns)

    def _frames_to_show(self, count: int) -> NDArray[np.bool_]:
        """Return at which of some measurements the plant's picture is drawn."""
        shown = np.ones(count, np.bool_)
        if self._columns is not None:
            shown[np.arange(count) % max(count // self._columns, 1) != 0] = False
        return shown

    def _show_deliveries(self, until_ns: int | None) -> None:
        """Draw deliveries once the rows of the network process about them must have arrived."""
        waiting = np.concatenate(self._undrawn)
        ready = np.full(len(waiting), True) if until_ns is None else waiting["t_ns"] <= until_ns
        self._undrawn = [waiting[~ready]]
        rows = waiting[ready]
        if not len(rows):
            return
        forced = np.array([int(sequence) in self._forced for sequence in rows["sequence"]])
        newest = int(rows["sequence"][-1])
        self._forced = {sequence for sequence in self._forced if sequence > newest}
        event_ns = rows["t_ns"]
        passed_s = _intervals_s(event_ns, self._last_delivery_ns)
        keep = self._rows_to_show(event_ns, passed_s)
        self._view.add_deliveries(event_ns[keep], passed_s[keep], forced[keep])
        self._last_delivery_ns = int(event_ns[-1])

    def _show_packets(self, rows: Rows) -> None:
        if not len(rows):
            return
        for flow in self._scenario.network.flows[1:]:
            reverse = messages_in(rows, flow)[0]
            self._view.add_packets(reverse["t_ns"], reverse["release_ns"], reverse["fate"], reverse=True)
        rows, sequence, event_ns = messages_in(rows)
        self._view.add_packets(event_ns, rows["release_ns"], rows["fate"])
        self._forced.update(sequence[rows["fate"] == Fate.FORCED].tolist())
        dropped = ~effective(rows["fate"])
        if dropped.any():
            lost_ns = event_ns[dropped]
            self._view.add_losses(lost_ns[self._rows_to_show(lost_ns, np.zeros(len(lost_ns)))])
        self._show_lateness("netem", rows)

    def _show_inputs(self, steps: Rows) -> None:
        if len(steps):
            keep = self._rows_to_show(steps["t_ns"], steps["u"])
            self._view.add_inputs(steps["t_ns"][keep], steps["u"][keep])
            self._show_lateness("controller", steps)

    def _show_lateness(self, process: str, rows: Rows) -> None:
        if len(rows):
            t_ns, late_ns = rows["t_ns"], rows["now_ns"] - rows["t_ns"]
            late_us = np.asarray(late_ns / (1e3 * self._scenario.speed), dtype=np.float64)
            keep = self._rows_to_show(t_ns, late_us)
            self._view.add_lateness(process, t_ns[keep], late_us[keep])


def _intervals_s(t_ns: Times, before_ns: int | None) -> Reals:
    """Return the times since the previous one, NaN for the first."""
    first = np.nan if before_ns is None else (t_ns[0] - before_ns) * 1e-9
    return np.concatenate([[first], np.diff(t_ns) * 1e-9])

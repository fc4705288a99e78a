"""The figures of a run, drawn from its record."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from cosim.analysis.timing_statistics import latency_us, lateness_us
from cosim.output.report import signal_figures
from cosim.output.report.axes import Bound, BoundKind
from cosim.output.report.decimate import Reals
from cosim.record.align import AlignedRun, align_tables
from cosim.record.estimation_error import true_states
from cosim.record.packet_outcomes import packet_outcomes
from cosim.record.run_record import RunRecord
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    Fate,
)
from noack.protocol.topology import LOOP_ROLES

Envelope = tuple[str, Literal["e_c", "x", "inter_event"], Reals, Reals, BoundKind]
"""A bound: label, bounded quantity, times in s (k,), values (k,), source."""


class RunFigure(NamedTuple):
    """A figure with its caption."""

    name: str
    figure: Figure
    caption: str
    description: str
    """Text alternative of the figure."""


BOUNDED = ("errors", "state-norm", "inter-event")
"""The figures that show certified bounds."""


def pictures(
    record: RunRecord, envelopes: Sequence[Envelope] = (), *, timed: bool | None = None
) -> dict[str, Callable[[], RunFigure]]:
    """Return functions that draw the figures of a run, by name.

    Args:
        record: the run's record, of any length, including 0.
        envelopes: certified bounds, drawn with the quantities that they bound.
        timed: whether to show lateness, which does not exist in virtual time.
    """

    @cache
    def joined() -> AlignedRun:
        with np.errstate(all="ignore"):  # a diverged run has figures, too
            return align_tables(record)

    found = {
        "states": lambda: _states(record, joined()),
        "errors": lambda: _errors(record, joined(), _bounding(envelopes, "e_c")),
        "state-norm": lambda: _state_norm(record, _bounding(envelopes, "x")),
        "input": lambda: _input(record),
        "inter-event": lambda: _inter_event(record, _bounding(envelopes, "inter_event")),
    }
    if record.kind == "live" if timed is None else timed:
        found |= {"lateness": lambda: _lateness(record), "latency": lambda: _latency(record)}
    return found


def _bounding(envelopes: Sequence[Envelope], quantity: str) -> list[Bound]:
    return [
        Bound(label, t_s, values, kind)
        for label, what, t_s, values, kind in envelopes
        if what == quantity
    ]


def _states(record: RunRecord, joined: AlignedRun) -> RunFigure:
    crossed = packet_outcomes(record)
    measurements, deliveries = record[SENSOR_MEASUREMENT], record[CONTROLLER_DELIVERY]
    events = measurements[measurements["event"] != NO_SEQUENCE]
    dropped = np.isin(events["event"], crossed.sequence[crossed.lost])
    forced = np.isin(deliveries["sequence"], crossed.sequence[crossed.rows["fate"] == Fate.FORCED])
    scenario, names = record.scenario, record.loop.state_names
    known = "x" if scenario.coverage.knows_state else "x̂"
    figure = signal_figures.paper_figure(
        mode=scenario.mode,
        t_s=_seconds(joined.t_ns),
        x=joined.x
        if scenario.coverage.knows_state
        else true_states(record[PLANT_STEP], joined.t_ns),
        x_hat=None if scenario.coverage.knows_state else joined.x,
        x_s=joined.x_s,
        x_c=joined.x_c,
        state_names=names,
        broadcast_s=_seconds(events["t_ns"]),
        dropped=dropped,
        received_s=_seconds(deliveries["t_ns"]),
        forced=forced,
        title=scenario.name,
    )
    return RunFigure(
        "states",
        figure,
        "States, and the times between transmissions and between deliveries. "
        + scenario.protocol.states_caption.format(known=known)
        + _known(scenario)
        + "Cross: a lost packet. Diamond: a delivery that was forced by the guarantee.",
        f"Above, the states {', '.join(names)} over time, each as x, x_s and x_c. Below, stems for "
        f"{len(events)} transmissions, of which {int(dropped.sum())} were lost, and for "
        f"{len(deliveries)} deliveries, of which {int(forced.sum())} were forced.",
    )


def _known(scenario: Scenario) -> str:
    """Explain x̂, if the sensor does not measure x exactly."""
    if scenario.coverage.knows_state:
        return ""
    if scenario.observer is None:
        return "x̂ is the measurement, x with noise. "
    outputs = (
        "1 output"
        if scenario.message_sizes.outputs == 1
        else f"{scenario.message_sizes.outputs} outputs"
    )
    return f"x̂ is the estimate of the observer, from {outputs}. "


def _errors(record: RunRecord, joined: AlignedRun, bounds: list[Bound]) -> RunFigure:
    t_s = _seconds(joined.t_ns)
    return RunFigure(
        "errors",
        signal_figures.error_figure(
            t_s, joined.e_s_norm, joined.threshold, joined.e_c_norm, bounds
        ),
        record.scenario.protocol.error_caption
        + (
            ""
            if record.scenario.coverage.knows_state
            else " Both are relative to x̂, the sensor's estimate of x."
        )
        + _dashed(bounds),
        "Error norms over time on a logarithmic axis: "
        f"‖e_s‖ up to {_largest(joined.e_s_norm)}, ‖e_c‖ up to {_largest(joined.e_c_norm)}.",
    )


def _state_norm(record: RunRecord, bounds: list[Bound]) -> RunFigure:
    steps = record[PLANT_STEP]
    with np.errstate(all="ignore"):
        x_norm = np.linalg.norm(steps["x"], axis=1)
    return RunFigure(
        "state-norm",
        signal_figures.state_norm_figure(_seconds(steps["t_ns"]), x_norm, bounds),
        "Norm of the plant's state." + _dashed(bounds),
        "Norm of the state over time on a logarithmic axis"
        + (f", from {x_norm[0]:.3g} to {x_norm[-1]:.3g}." if len(x_norm) else "."),
    )


def _input(record: RunRecord) -> RunFigure:
    steps, names = record[CONTROLLER_STEP], record.loop.input_names
    return RunFigure(
        "input",
        signal_figures.input_figure(_seconds(steps["t_ns"]), steps["u"], names),
        "Control input u = K x_c, held between the controller's ticks. Equal inputs are drawn one "
        "inside the other.",
        f"Control inputs {', '.join(names)} over time.",
    )


def _inter_event(record: RunRecord, lower_bounds: list[Bound]) -> RunFigure:
    measurements = record[SENSOR_MEASUREMENT]
    event_s = _seconds(measurements["t_ns"][measurements["event"] != NO_SEQUENCE])
    return RunFigure(
        "inter-event",
        signal_figures.inter_event_figure(event_s, lower_bounds, record.scenario.horizon_s),
        "Inter-event times, over time and as a histogram." + _dashed(lower_bounds),
        "Inter-event times on a logarithmic axis"
        + (f", the shortest {np.diff(event_s).min():.3g} s." if len(event_s) > 1 else "."),
    )


def _lateness(record: RunRecord) -> RunFigure:
    scenario = record.scenario
    period_us = scenario.timing.plant_period_ns / (1e3 * scenario.speed)
    late_us = {role: lateness_us(record, role) for role in LOOP_ROLES}
    longest = ", ".join(f"{role} {_largest(late)} µs" for role, late in late_us.items())
    return RunFigure(
        "lateness",
        signal_figures.lateness_figure(late_us, period_us),
        "Share of a process's steps with at least this lateness. Lateness is measured from the "
        "deadline (plant, controller), the time of the measurement (sensor), or the event "
        "(network).",
        f"Complementary distribution of lateness on logarithmic axes; maximum: {longest}.",
    )


def _latency(record: RunRecord) -> RunFigure:
    event_ns, taken_us = latency_us(record)
    return RunFigure(
        "latency",
        signal_figures.latency_figure(_seconds(event_ns), taken_us, record.scenario.horizon_s),
        "Sensor-to-controller latency: wall time from the event to the controller's update.",
        f"Latencies of {len(taken_us)} updates, the longest {_largest(taken_us)} µs.",
    )


def _dashed(curves: Sequence[Bound]) -> str:
    return " Dashed: claimed bounds." if curves else ""


def _largest(values: Reals) -> str:
    values = values[np.isfinite(values)]
    return f"{values.max():.3g}" if len(values) else "unknown"


def _seconds(t_ns: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> Reals:
    return np.asarray(t_ns / NS_PER_S, dtype=np.float64)

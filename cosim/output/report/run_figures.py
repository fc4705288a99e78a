"""The figures of a run, drawn from its record."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from cosim.analysis.loop_statistics import latency_us, lateness_parts
from cosim.analysis.value_reduction import QuantileSketch, Reals, decimate, decimate_all
from cosim.output.report import signal_figures
from cosim.output.report.axes import Bound, BoundKind
from cosim.output.report.clock_figure import ClockErrors, clock_errors, clock_figure
from cosim.output.report.loss_figure import LossPanel, loss_figure
from cosim.record.align import AlignedRun, aligned_parts
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.impairments.loss_guarantee import LossesInWindow
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    PLANT_STEP,
    Fate,
)
from noack.protocol.topology import LOOP_ROLES
from noack.protocol.wire_format import Flow

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
    def aligned() -> _Thinned:
        with np.errstate(all="ignore"):  # a diverged run has figures, too
            return _thinned(record)

    found = {
        "states": lambda: _states(record, aligned()),
        "errors": lambda: _errors(record, aligned().run, _bounding(envelopes, "e_c")),
        "state-norm": lambda: _state_norm(record, _bounding(envelopes, "x")),
        "input": lambda: _input(record),
        "inter-event": lambda: _inter_event(record, _bounding(envelopes, "inter_event")),
        "losses": lambda: _losses(record),
    }
    if record.kind == "live" if timed is None else timed:
        found |= {"lateness": lambda: _lateness(record), "latency": lambda: _latency(record)}
    if errors := clock_errors(record):
        found["clocks"] = lambda: _clocks(record.scenario, errors)
    return found


def _bounding(envelopes: Sequence[Envelope], quantity: str) -> list[Bound]:
    return [
        Bound(label, t_s, values, kind)
        for label, what, t_s, values, kind in envelopes
        if what == quantity
    ]


class _Thinned(NamedTuple):
    """The samples of a run that its figures need: all of a short run."""

    run: AlignedRun
    true_x: Reals | None


def _thinned(record: RunRecord) -> _Thinned:
    """Align a run; of each part, keep the extremes of all curves at the resolution of a figure."""
    found = []
    for part in aligned_parts(record):
        run, true_x = _from_first_update(part.aligned, record), part.true_x
        curves = [run.x, run.x_s, run.x_c, run.e_s_norm, run.threshold, run.e_c_norm]
        curves += [] if true_x is None else [true_x]
        keep = decimate_all(_seconds(run.t_ns), np.column_stack(curves), record.slice_columns)
        thin = AlignedRun._make(values[keep] for values in run)
        found.append(_Thinned(thin, None if true_x is None else true_x[keep]))
    whole = AlignedRun._make(map(np.concatenate, zip(*(one.run for one in found), strict=True)))
    true_states = [one.true_x for one in found if one.true_x is not None]
    return _Thinned(whole, np.concatenate(true_states) if true_states else None)


def _from_first_update(run: AlignedRun, record: RunRecord) -> AlignedRun:
    """Return the samples without the controller's state and error where it knows no state."""
    known = run.since_delivery(record.scenario)
    return run._replace(
        x_c=np.where(known[:, None], run.x_c, np.nan),
        e_c_norm=np.where(known, run.e_c_norm, np.nan),
    )


def _reduced(record: RunRecord, table: str, column: str) -> tuple[Reals, Reals]:
    """Return times in s (k,) and a vector column (k, n), reduced like the aligned samples."""
    t_s, values = [np.zeros(0)], [np.zeros((0, record.tables[table][column].shape[0]))]
    for rows in record.source.batches(table, ("t_ns", column)):
        part_s = _seconds(rows["t_ns"])
        keep = decimate_all(part_s, rows[column], record.slice_columns)
        t_s.append(part_s[keep])
        values.append(rows[column][keep])
    return np.concatenate(t_s), np.concatenate(values)


def _states(record: RunRecord, aligned: _Thinned) -> RunFigure:
    crossed, joined = packet_outcomes(record), aligned.run
    events = record.events()
    deliveries = record.columns(CONTROLLER_DELIVERY, "t_ns", "sequence")
    dropped = np.isin(events["event"], crossed.sequence[crossed.lost])
    forced = np.isin(deliveries["sequence"], crossed.sequence[crossed.fate == Fate.FORCED])
    scenario, names = record.scenario, record.loop.state_names
    known = "x" if scenario.coverage.knows_state else "x̂"
    figure = signal_figures.paper_figure(
        mode=scenario.mode,
        t_s=_seconds(joined.t_ns),
        x=joined.x if aligned.true_x is None else aligned.true_x,
        x_hat=None if aligned.true_x is None else joined.x,
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
    t_s, x_norm = _state_norms(record)
    return RunFigure(
        "state-norm",
        signal_figures.state_norm_figure(t_s, x_norm, bounds),
        "Norm of the plant's state." + _dashed(bounds),
        "Norm of the state over time on a logarithmic axis"
        + (f", from {x_norm[0]:.3g} to {x_norm[-1]:.3g}." if len(x_norm) else "."),
    )


@np.errstate(all="ignore")
def _state_norms(record: RunRecord) -> tuple[Reals, Reals]:
    """Return times in s, (k,), and norms of the plant's state, (k,), reduced."""
    t_s, norms = [np.zeros(0)], [np.zeros(0)]
    for steps in record.source.batches(PLANT_STEP, ("t_ns", "x")):
        part_s, x_norm = _seconds(steps["t_ns"]), np.linalg.norm(steps["x"], axis=1)
        keep = decimate(part_s, x_norm, record.slice_columns)
        t_s.append(part_s[keep])
        norms.append(x_norm[keep])
    return np.concatenate(t_s), np.concatenate(norms)


def _input(record: RunRecord) -> RunFigure:
    names, table = record.loop.input_names, CONTROLLER_STEP
    title, caption = "Control input $u = K x_c$", "Control input u = K x_c, held between ticks."
    if record.scenario.network.actuation is not None:
        table, title = PLANT_STEP, "Applied input"
        caption = "Input that the plant applied, also while actuations were missing."
    t_s, u = _reduced(record, table, "u")
    return RunFigure(
        "input",
        signal_figures.input_figure(t_s, u, names, title),
        f"{caption} Equal inputs are drawn one inside the other.",
        f"Control inputs {', '.join(names)} over time.",
    )


def _inter_event(record: RunRecord, lower_bounds: list[Bound]) -> RunFigure:
    event_s = _seconds(record.events()["t_ns"])
    return RunFigure(
        "inter-event",
        signal_figures.inter_event_figure(event_s, lower_bounds, record.scenario.horizon_s),
        "Inter-event times, over time and as a histogram." + _dashed(lower_bounds),
        "Inter-event times on a logarithmic axis"
        + (f", the shortest {np.diff(event_s).min():.3g} s." if len(event_s) > 1 else "."),
    )


def _losses(record: RunRecord) -> RunFigure:
    outcomes, network = packet_outcomes(record), record.scenario.network
    bursts = outcomes.loss_bursts()
    kept = "the guarantee" if network.enforce_mansd else "the assumption (not enforced)"
    panels = [
        LossPanel("Consecutive losses", "consecutive losses", "bursts", bursts,
                  network.longest_burst)
    ]  # fmt: skip
    panels += [
        LossPanel(f"Losses in {rule.window} updates", f"losses in {rule.window} consecutive "
                  "updates", "positions", outcomes.losses_in(rule.window), rule.limit)
        for rule in network.guarantee.rules[:3] if isinstance(rule, LossesInWindow)
    ]  # fmt: skip
    longest, both = int(bursts.max(initial=0)), ""
    if (actuation := network.actuation) is not None:
        lost = packet_outcomes(record, Flow.ACTUATION).loss_bursts()
        limit, both = actuation.link.longest_burst, " Last panel: the same of actuations."
        panels.append(
            LossPanel("Of actuations", "consecutive lost actuations", "bursts", lost, limit)
        )
    return RunFigure(
        "losses",
        loss_figure(panels),
        "Effective losses of updates: dropped, corrupted, or delivered out of order. "
        f"Dashed: the largest number that {kept} allows: {network.guarantee.meaning}.{both}",
        f"{len(bursts)} bursts of losses, the longest of {longest}; at most "
        f"{network.longest_burst} consecutive losses are allowed.",
    )


def _lateness(record: RunRecord) -> RunFigure:
    scenario = record.scenario
    period_us = scenario.timing.plant_period_ns / (1e3 * scenario.speed)
    late_us = {role: QuantileSketch.of(lateness_parts(record, role)) for role in LOOP_ROLES}
    maxima = {role: sketch.quantile(1.0) for role, sketch in late_us.items()}
    longest = ", ".join(
        f"{role} {'unknown' if most is None else f'{most:.3g}'} µs" for role, most in maxima.items()
    )
    return RunFigure(
        "lateness",
        signal_figures.lateness_figure(late_us, period_us),
        "Share of a process's steps with at least this lateness. Lateness is measured from the "
        "deadline (plant, controller), the time of the measurement (sensor), or the arrival "
        "of the datagram at the socket (network).",
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


def _clocks(scenario: Scenario, errors: Mapping[str, ClockErrors]) -> RunFigure:
    assert scenario.clocks is not None  # else the record has no tables of clocks
    largest = ", ".join(
        f"{process} " + ("never known" if one.largest_us is None else f"{one.largest_us:.3g} µs")
        for process, one in errors.items()
    )
    lost = [process for process, one in errors.items() if one.lost.any()]
    return RunFigure(
        "clocks",
        clock_figure(errors, scenario.clocks.largest_error_us, scenario.horizon_s),
        "Bound of the difference between a process's time and the recorder's, for the processes "
        f"on hosts with other clocks. Largest: {largest}. Dashed: the largest bound with which "
        "claims hold."
        + (f" Cross: from here on, the bound was lost ({', '.join(lost)})." if lost else ""),
        f"Bounds of the clocks' errors over time on a logarithmic axis; largest: {largest}.",
    )


def _dashed(curves: Sequence[Bound]) -> str:
    return " Dashed: claimed bounds." if curves else ""


def _largest(values: Reals) -> str:
    values = values[np.isfinite(values)]
    return f"{values.max():.3g}" if len(values) else "unknown"


def _seconds(t_ns: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> Reals:
    return np.asarray(t_ns / NS_PER_S, dtype=np.float64)

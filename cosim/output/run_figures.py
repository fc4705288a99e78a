"""The figures of a run, from its record: those of one loop, and those of loops on one network.

:func:`page_figures` returns the figures of a run's page; :func:`run_figures` those of one loop,
:func:`network_figures` those of all loops together.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.claim_evaluation import claims_of
from cosim.analysis.loop_statistics import latency_us, lateness_parts
from cosim.analysis.network_summary import LoopsOverTime, loops_over_time, quantiles
from cosim.analysis.summary_model import InFlightPart, RunSummary
from cosim.analysis.value_reduction import QuantileSketch, decimate, decimate_all
from cosim.output import palette, signal_figures
from cosim.output.figure_description import (
    Axis,
    Band,
    BoundKind,
    ColourScale,
    FigureDescription,
    Heat,
    Item,
    Line,
    Panel,
    Row,
    bound_lines,
    plain,
    time_axis,
)
from cosim.output.signal_figures import ClockErrors, LossPanel
from cosim.record.align import AlignedRun, Reals, aligned_parts
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RecordedRun, RunRecord
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.number_format import number
from noack.impairments.loss_guarantee import LossesInWindow
from noack.protocol.record_tables import (
    CLOCK_TABLES,
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    LOST_NS,
    OWNER,
    PLANT_STEP,
    Fate,
)
from noack.protocol.topology import LOOP_ROLES
from noack.protocol.wire_format import Flow

Envelope = tuple[str, Literal["e_c", "x", "inter_event"], Reals, Reals, BoundKind]
"""A bound: label, bounded quantity, times in s (k,), values (k,), source."""


BOUNDED = ("errors", "state-norm", "inter-event")
"""The figures that show certified bounds."""


def run_figures(
    record: RunRecord, envelopes: Sequence[Envelope] = (), *, timed: bool | None = None
) -> dict[str, Callable[[], FigureDescription]]:
    """Return functions that describe the figures of a run, by name.

    Args:
        record: the run's record, of any length, including 0.
        envelopes: certified bounds, drawn with the quantities that they bound.
        timed: whether to show lateness, which does not exist in virtual time.
    """

    @cache
    def aligned() -> _Thinned:
        with np.errstate(all="ignore"):  # a diverged run has figures, too
            return _thinned(record)

    described = {
        "states": lambda: _states(record, aligned()),
        "errors": lambda: _errors(record, aligned().run, _bounding(envelopes, "e_c")),
        "state-norm": lambda: _state_norm(record, _bounding(envelopes, "x")),
        "input": lambda: _input(record),
        "inter-event": lambda: _inter_event(record, _bounding(envelopes, "inter_event")),
        "losses": lambda: _losses(record),
    }
    if record.kind == "live" if timed is None else timed:
        described |= {"lateness": lambda: _lateness(record), "latency": lambda: _latency(record)}
    if errors := clock_errors(record):
        described["clocks"] = lambda: _clocks(record.scenario, errors)
    return described


def envelopes(record: RunRecord) -> Sequence[Envelope]:
    """Return the certified bounds of a loop, to be drawn with the quantities that they bound."""
    try:
        return claims_of(record).envelopes()
    except Exception:  # the figures are useful without them
        return []


def _bounding(envelopes: Sequence[Envelope], quantity: str) -> list[Line]:
    return bound_lines(
        (label, t_s, values, kind)
        for label, what, t_s, values, kind in envelopes
        if what == quantity
    )


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
    """Return the samples without the controller's state and error before its first update."""
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


def _states(record: RunRecord, aligned: _Thinned) -> FigureDescription:
    crossed, joined = packet_outcomes(record), aligned.run
    events = record.events()
    deliveries = record.columns(CONTROLLER_DELIVERY, "t_ns", "sequence")
    dropped = np.isin(events["event"], crossed.sequence[crossed.lost])
    forced = np.isin(deliveries["sequence"], crossed.sequence[crossed.fate == Fate.FORCED])
    scenario, names = record.scenario, record.loop.state_names
    known = "x" if scenario.coverage.knows_state else "x̂"
    return signal_figures.states_figure(
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
    ).captioned(
        "States, and the times between transmissions and between deliveries. "
        + scenario.protocol.states_caption.format(known=known)
        + _known(scenario)
        + "Cross: a lost packet. Diamond: a delivery that was forced by the guarantee.",
        f"Above, the states {', '.join(names)} over time, each as x, x_s and x_c. "
        f"Below, stems for {len(events)} transmissions, of which {int(dropped.sum())} were "
        f"lost, and for {len(deliveries)} deliveries, of which {int(forced.sum())} were forced.",
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


def _errors(record: RunRecord, joined: AlignedRun, bounds: list[Line]) -> FigureDescription:
    t_s = _seconds(joined.t_ns)
    return signal_figures.error_figure(
        t_s, joined.e_s_norm, joined.threshold, joined.e_c_norm, bounds
    ).captioned(
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


def _state_norm(record: RunRecord, bounds: list[Line]) -> FigureDescription:
    t_s, x_norm = _state_norms(record)
    return signal_figures.state_norm_figure(t_s, x_norm, bounds).captioned(
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


def _input(record: RunRecord) -> FigureDescription:
    names, table = record.loop.input_names, CONTROLLER_STEP
    title, caption = "Control input $u = K x_c$", "Control input u = K x_c, held between ticks."
    if record.scenario.network.actuation is not None:
        table, title = PLANT_STEP, "Applied input"
        caption = "Input that the plant applied, also while actuations were missing."
    t_s, u = _reduced(record, table, "u")
    return signal_figures.input_figure(t_s, u, names, title).captioned(
        f"{caption} Equal inputs are drawn one inside the other.",
        f"Control inputs {', '.join(names)} over time.",
    )


def _inter_event(record: RunRecord, lower_bounds: list[Line]) -> FigureDescription:
    event_s = _seconds(record.events()["t_ns"])
    return signal_figures.inter_event_figure(
        event_s, lower_bounds, record.scenario.horizon_s
    ).captioned(
        "Inter-event times, over time and as a histogram." + _dashed(lower_bounds),
        "Inter-event times on a logarithmic axis"
        + (f", the shortest {np.diff(event_s).min():.3g} s." if len(event_s) > 1 else "."),
    )


def _losses(record: RunRecord) -> FigureDescription:
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
    return signal_figures.loss_figure(panels).captioned(
        "Effective losses of updates: dropped, corrupted, or delivered out of order. "
        f"Dashed: the largest number that {kept} allows: {network.guarantee.meaning}.{both}",
        f"{len(bursts)} bursts of losses, the longest of {longest}; at most "
        f"{network.longest_burst} consecutive losses are allowed.",
    )


def _lateness(record: RunRecord) -> FigureDescription:
    scenario = record.scenario
    period_us = scenario.timing.plant_period_ns / (1e3 * scenario.speed)
    late_us = {role: QuantileSketch.of(lateness_parts(record, role)) for role in LOOP_ROLES}
    maxima = {role: sketch.quantiles(1.0)[0] for role, sketch in late_us.items()}
    longest = ", ".join(
        f"{role} {'unknown' if most is None else f'{most:.3g}'} µs" for role, most in maxima.items()
    )
    return signal_figures.lateness_figure(late_us, period_us).captioned(
        "Share of a process's steps with at least this lateness. Lateness is measured "
        "from the deadline (plant, controller), the time of the measurement (sensor), or the "
        "arrival of the datagram at the socket (network).",
        f"Complementary distribution of lateness on logarithmic axes; maximum: {longest}.",
    )


def _latency(record: RunRecord) -> FigureDescription:
    event_ns, taken_us = latency_us(record)
    return signal_figures.latency_figure(
        _seconds(event_ns), taken_us, record.scenario.horizon_s
    ).captioned(
        "Sensor-to-controller latency: wall time from the event to the controller's update.",
        f"Latencies of {len(taken_us)} updates, the longest {_largest(taken_us)} µs.",
    )


def clock_errors(record: RunRecord) -> dict[str, ClockErrors]:
    """Return the bounds of the processes whose clock is not the recorder's, by process."""
    errors = {}
    for table in CLOCK_TABLES:
        if table not in record.tables:
            continue
        rows = record.columns(table, "t_ns", "error_ns")
        if (rows["error_ns"] != 0).any():
            error_us = np.where(rows["error_ns"] == LOST_NS, np.nan, rows["error_ns"] * 1e-3)
            errors[OWNER[table]] = ClockErrors(rows["t_ns"] / NS_PER_S, error_us)
    return errors


def _clocks(scenario: Scenario, errors: Mapping[str, ClockErrors]) -> FigureDescription:
    assert scenario.clocks is not None  # else the record has no tables of clocks
    largest = ", ".join(
        f"{process} " + ("never known" if one.largest_us is None else f"{one.largest_us:.3g} µs")
        for process, one in errors.items()
    )
    lost = [process for process, one in errors.items() if one.lost.any()]
    return signal_figures.clock_figure(
        errors, scenario.clocks.largest_error_us, scenario.horizon_s
    ).captioned(
        "Bound of the difference between a process's time and the recorder's, for the "
        f"processes on hosts with other clocks. Largest: {largest}. Dashed: the largest bound with "
        "which claims hold."
        + (f" Cross: from here on, the bound was lost ({', '.join(lost)})." if lost else ""),
        f"Bounds of the clocks' errors over time on a logarithmic axis; largest: {largest}.",
    )


def _dashed(curves: Sequence[Line]) -> str:
    return " Dashed: claimed bounds." if curves else ""


def _largest(values: Reals) -> str:
    values = values[np.isfinite(values)]
    return f"{values.max():.3g}" if len(values) else "unknown"


def _seconds(t_ns: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> Reals:
    return np.asarray(t_ns / NS_PER_S, dtype=np.float64)


Bools = NDArray[np.bool_]

NAMED = len(palette.SERIES)
"""Up to so many loops have a curve each, in a colour of its own; more are drawn as bands."""
_PANEL_IN = 1.7
_ROW_IN, _LOWEST_IN, _HIGHEST_IN = 0.22, 1.2, 4.5
_MAP_DECADES = 5
_MOST_ROWS = 24
"""Up to so many rows of the map have the names of their loops."""
_BANDS = ((0, 4, 0.25, "5 to 95 % of the loops"), (1, 3, 0.45, "25 to 75 %"))
_MEDIAN, _LARGEST = 2, 5


def page_figures(
    run: RecordedRun,
    summary: Callable[[], RunSummary],
    loop: str | None = None,
    *,
    bounded: bool = True,
) -> Mapping[str, Callable[[], FigureDescription]]:
    """Return functions that describe the figures of a run's page, or of a loop's, by name.

    Args:
        run: the record.
        summary: returns the summary, which the figures of a network need.
        loop: name of the loop; None for the run.
        bounded: whether certified bounds are drawn, which are slow to compute.
    """
    if loop is None and run.names[1:]:
        figures = {figure.name: figure for figure in network_figures(run, summary())}
        return {name: partial(figures.__getitem__, name) for name in figures}
    record = run.loop(loop)
    return run_figures(record, envelopes(record) if bounded else ())


def network_figures(run: RecordedRun, summary: RunSummary) -> list[FigureDescription]:
    """Describe the figures of all loops.

    Raises:
        CallerError: a table of the record is damaged.
    """
    over_time = loops_over_time(run)
    names = [plain(loop.name) for loop in summary.loops]
    stayed = np.array([loop.diverged_at_s is None for loop in summary.loops])
    in_flight = summary.network.in_flight
    curves = "Each loop has a curve."
    if len(names) > NAMED:
        curves = "Bands: quantiles over the loops; dashed: the largest value."
    diverged = "" if stayed.all() else " A loop that diverged leaves the range of the axis."
    order = "" if len(names) <= _MOST_ROWS else " Loops are numbered from 0, as in the scenario."
    largest = over_time.errors[np.isfinite(over_time.errors)].max(initial=0.0)
    return [
        FigureDescription(
            name="network",
            rows=_link_rows(over_time, names, in_flight),
            caption="Above: datagrams that wait, are sent or are delayed in the network. Below: "
            f"each loop's share of the bytes that the network forwarded. {curves}",
            description=f"Above, the number of datagrams in the network over time, up to "
            f"{in_flight.max}. Below, the shares of {len(names)} loops in the bytes that the "
            "network forwarded.",
        ),
        norms_figure(over_time, names, stayed).captioned(
            "Largest error ‖e_c‖ of the controller's model, and largest norm ‖x‖ of the plant's "
            f"state, in each of {len(over_time.middles_s)} intervals. {curves}{diverged}",
            f"Norms of {len(names)} loops over time on logarithmic axes; ‖e_c‖ is at most "
            f"{number(largest)}.",
        ),
        error_map(over_time, names, stayed).captioned(
            "Largest ‖e_c‖ of each loop in each interval; no colour before its first "
            f"delivery.{order}",
            f"A row of colours for each of {len(names)} loops: ‖e_c‖ over time.",
        ),
    ]  # fmt: skip


def _link_rows(
    over_time: LoopsOverTime, names: Sequence[str], in_flight: InFlightPart
) -> list[Row]:
    """Describe the number of datagrams in the network, and the share of each loop of the bytes."""
    most = np.asarray(in_flight.max_by_interval, np.float64)
    mean = np.asarray(in_flight.mean_by_interval, np.float64)
    t_s = np.asarray((np.arange(len(mean)) + 0.5) * in_flight.width_s, np.float64)
    queue: list[Item] = [
        Band(x=t_s, low=np.zeros(len(t_s)), high=most, label="largest of an interval",
             colour=palette.NETWORK, opacity=0.3, steps="mid"),
        Line(x=t_s, y=mean, label="mean", colour=palette.NETWORK),
    ]  # fmt: skip
    ends_s, shares = over_time.shares()
    return _rows(
        over_time,
        ("Datagrams in the network", queue, Axis(label="datagrams", ends=(0.0, None))),
        ("Share of the link", _curves(ends_s - ends_s[0] / 2, 100 * shares, names),
         Axis(label="%", ends=(0.0, None))),
    )  # fmt: skip


def norms_figure(
    over_time: LoopsOverTime, names: Sequence[str], stayed: Bools
) -> FigureDescription:
    """Describe ‖e_c‖ and ‖x‖ of all loops; the range of the axes is for those that stayed."""
    panels = []
    for title, values in (
        (r"$\|e_c\|$ controller", over_time.errors), (r"$\|x\|$ plant", over_time.states),
    ):  # fmt: skip
        about = _not_diverged(values, stayed).ravel()
        axis = Axis(label="norm", logarithmic=True, about=about, decades=_MAP_DECADES)
        panels.append((title, _curves(over_time.middles_s, values, names), axis))
    return FigureDescription(name="loops", rows=_rows(over_time, *panels))


def _rows(over_time: LoopsOverTime, *panels: tuple[str, Sequence[Item], Axis]) -> list[Row]:
    """Return panels, one above the other, with the time axis of the run."""
    return [
        Row(height_in=_PANEL_IN, panels=[
            Panel(title=title, items=items, y=y,
                  x=time_axis(over_time.edges_s, numbers=i == len(panels) - 1))
        ])
        for i, (title, items, y) in enumerate(panels)
    ]  # fmt: skip


def _curves(t_s: Reals, values: Reals, names: Sequence[str]) -> list[Item]:
    """Describe a curve for each of a few loops, (L, k) over (k,), or quantiles over many."""
    if len(names) <= NAMED:
        return [
            Line(x=t_s, y=curve, label=name, colour=colour)
            for name, colour, curve in zip(names, palette.SERIES, values, strict=False)
        ]
    levels = quantiles(values)
    return [
        *(
            Band(x=t_s, low=levels[low], high=levels[high], label=label, opacity=opacity,
                 colour=palette.CONTROLLER)
            for low, high, opacity, label in _BANDS
        ),
        Line(x=t_s, y=levels[_MEDIAN], label="median", colour=palette.CONTROLLER),
        Line(x=t_s, y=levels[_LARGEST], label="largest", colour=palette.LOST, width=1.0,
             dash=(3, 1.5)),
    ]  # fmt: skip


def error_map(over_time: LoopsOverTime, names: Sequence[str], stayed: Bools) -> FigureDescription:
    """Describe ‖e_c‖ of each loop, a row, over time, as colours.

    Args:
        over_time: the errors.
        names: of the loops.
        stayed: (L,) the loops that did not diverge, to which the colours are scaled.
    """
    count, values = len(names), np.where(over_time.errors > 0, over_time.errors, np.nan)
    scale = None
    if np.isfinite(values).any():
        measured = _not_diverged(values, stayed)
        most = float(np.nanmax(measured))
        least = max(float(np.nanmin(measured)), most / 10**_MAP_DECADES)
        values[over_time.errors == 0] = least  # just after an update
        scale = ColourScale(
            low=least, high=most if most > least else 2 * least, logarithmic=True,
            exceeded=float(np.nanmax(values)) > most,
        )  # fmt: skip
    heat = Heat(values=values, x_ends=(0.0, float(over_time.edges_s[-1])), downwards=True)
    are_named = count <= _MOST_ROWS
    panel = Panel(
        title=r"$\|e_c\|$ of each loop",
        items=[] if scale is None else [heat],
        x=replace(time_axis(over_time.edges_s), grid=False),
        y=Axis(
            label="" if are_named else "number of the loop", grid=False,
            ticks=dict(enumerate(names)) if are_named else None,
        ),
    )  # fmt: skip
    height_in = min(max(count * _ROW_IN, _LOWEST_IN), _HIGHEST_IN)
    rows = [Row(panels=[panel], height_in=height_in)]
    return FigureDescription(name="map", rows=rows, scale=scale)


def _not_diverged(values: Reals, stayed: Bools) -> Reals:
    """Return the values of the loops that did not diverge; if none is known, of all."""
    measured = values[stayed]
    return measured if np.isfinite(measured).any() else values

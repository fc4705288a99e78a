"""The figures of one loop, from its record.

Records may have any length, including 0, and values that are not finite. Norms are those of the
run's trigger, ‖v‖ = ‖W v‖₂. In every figure, grey is the plant, blue the sensor, orange the
controller; dashed curves are certified bounds.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import groupby
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.claim_evaluation import claims_of
from cosim.output.curves import (
    BoundKind,
    Curve,
    Quantity,
    bound_curves,
    error_curves,
    input_curves,
    norm_curve,
    state_curves,
    transmission_curves,
)
from cosim.output.figures import palette
from cosim.output.figures.figure_description import (
    Axis,
    Bars,
    FigureDescription,
    Item,
    Line,
    Marks,
    Panel,
    PanelRow,
    Rule,
    finite,
    label_text,
    one_panel,
    time_axis,
)
from cosim.output.figures.palette import CONTROLLER, FORCED, LOST, SENSOR
from cosim.output.figures.timing_figures import (
    inter_event_figure,
    largest_text,
    latency_figure,
    lateness_figure,
)
from cosim.record.align import AlignedRun, Reals, aligned_parts
from cosim.record.decimation import decimate_all
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord
from noack.core.clock import NS_PER_S
from noack.core.row_operations import row_norms
from noack.guarantee.loss_guarantee import LossesInWindow
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, PLANT_STEP, Fate
from noack.protocol.wire_format import Flow
from noack.scenario.scenario import Scenario

Flags = NDArray[np.bool_]
Envelope = tuple[str, Quantity, Reals, Reals, BoundKind]
"""A bound: label, bounded quantity, times in s (k,), values (k,), source."""

BOUNDED = ("errors", "state-norm", "inter-event")
"""The figures that show certified bounds."""
_STATES_NARROWEST_IN, _LOSSES_NARROWEST_IN, _LOSSES_WIDEST_IN = 1.7, 2.2, 5.0
"""Widths of a panel of these figures, in inches."""
_MOST_STATES = 16
_LONGEST_TITLE = 40  # characters
_DECADES = 6
"""Maximum decades of an axis of norms."""
_FAR_RATIO, _FAR_OPACITY = 20.0, 0.45
"""A bound that is mostly over this ratio times the curve is drawn with this opacity."""
_MOST_NUMBERED_BARS = 12
_NEAR_LIMIT, _NEAR_LIMIT_RATIO = 50, 10
"""A limit of losses is drawn up to this number, or to this multiple of the largest number that occurred."""
_SYMBOLS = {
    "x": "$x$",
    "x_s": "$x_s$",
    "x_c": "$x_c$",
    "x̂": r"$\hat{x}$",
    "‖x‖": r"$\|x\|$",
    "‖e_s‖": r"$\|e_s\|$",
    "‖e_c‖": r"$\|e_c\|$",
}
"""The symbols with which the names of curves begin, and how a figure writes them."""


def run_figures(
    record: RunRecord, certified: Sequence[Envelope] = (), *, timed: bool | None = None
) -> dict[str, Callable[[], FigureDescription]]:
    """Return functions that describe the figures of a loop, by name.

    Args:
        record: the loop's record, of any length, including 0.
        certified: bounds, drawn with the quantities that they bound.
        timed: whether to show lateness, which does not exist in virtual time.
    """

    @cache
    def aligned() -> _Thinned:
        with np.errstate(all="ignore"):  # a diverged run has figures, too
            return _thinned(record)

    def bounds(quantity: Quantity) -> list[Line]:
        curves = bound_curves(envelope for envelope in certified if envelope[1] == quantity)
        return [_bound_line(curve) for curve in curves]

    figures = {
        "states": lambda: _states(record, aligned()),
        "errors": lambda: _errors(record.scenario, aligned().run, bounds("e_c")),
        "state-norm": lambda: _state_norm(record, bounds("x")),
        "input": lambda: _input(record),
        "inter-event": lambda: inter_event_figure(record, bounds("inter_event")),
        "losses": lambda: _losses(record),
    }
    if record.kind == "live" if timed is None else timed:
        figures |= {
            "lateness": lambda: lateness_figure(record),
            "latency": lambda: latency_figure(record),
        }
    return figures


def run_curves(record: RunRecord) -> list[Curve]:
    """Return the curves of a loop: states, errors, ‖x‖, inputs, transmissions, certified bounds."""
    with np.errstate(all="ignore"):  # a diverged run has curves, too
        samples = _thinned(record)
    events = record.events()
    delivered = np.isin(events["event"], record.columns(CONTROLLER_DELIVERY, "sequence")["sequence"])
    return [
        *_states_of(record, samples),
        *_errors_of(samples.run),
        norm_curve(*_decimated(record, PLANT_STEP, "x", row_norms)),
        *input_curves(record.loop.input_names, *_decimated(record, CONTROLLER_STEP, "u")),
        *transmission_curves(_seconds(events["t_ns"]), delivered),
        *bound_curves(envelopes(record)),
    ]


def _line(curve: Curve, order: float = 2.0) -> Line:
    """Return a curve for a figure, whose text names it by its symbol."""
    symbol, _, source = curve.name.partition(" ")
    label, style = f"{_SYMBOLS.get(symbol, symbol)} {source}".strip(), curve.style
    return Line(
        x=curve.t_s,
        y=curve.values,
        label=label,
        colour=style.colour,
        width=style.width,
        dash=style.dash,
        steps="post" if style.is_held else "",
        order=order,
    )


def _bound_line(curve: Curve) -> Line:
    """Return the curve of a bound, with gaps where it is 0: they show the curve behind."""
    return replace(_line(curve), label=curve.name, y=finite(curve.values, positive=True))


def envelopes(record: RunRecord) -> Sequence[Envelope]:
    """Return the certified bounds of a loop, to be drawn with the quantities that they bound."""
    try:
        return claims_of(record).envelopes()
    except Exception:  # the figures are useful without them
        return []


class _Thinned(NamedTuple):
    """The samples of a run that its figures need: all of a short run."""

    run: AlignedRun
    true_x: Reals | None


def _thinned(record: RunRecord) -> _Thinned:
    """Align a run; of each part, keep the extremes of all curves at the resolution of a figure."""
    parts = []
    for part in aligned_parts(record):
        run, true_x = _from_first_update(part.aligned, record), part.true_x
        curves = [run.x, run.x_s, run.x_c, run.e_s_norm, run.threshold, run.e_c_norm]
        curves += [] if true_x is None else [true_x]
        keep = decimate_all(_seconds(run.t_ns), np.column_stack(curves), record.slice_columns)
        thin = AlignedRun._make(values[keep] for values in run)
        parts.append(_Thinned(thin, None if true_x is None else true_x[keep]))
    whole = AlignedRun._make(map(np.concatenate, zip(*(part.run for part in parts), strict=True)))
    true_states = [part.true_x for part in parts if part.true_x is not None]
    return _Thinned(whole, np.concatenate(true_states) if true_states else None)


def _from_first_update(run: AlignedRun, record: RunRecord) -> AlignedRun:
    """Return the samples without the controller's state and error before its first update."""
    known = run.since_delivery(record.scenario)
    return run._replace(
        x_c=np.where(known[:, None], run.x_c, np.nan),
        e_c_norm=np.where(known, run.e_c_norm, np.nan),
    )


@np.errstate(all="ignore")  # a run may diverge
def _decimated(
    record: RunRecord, table: str, column: str, curves: Callable[[Reals], Reals] = np.asarray
) -> tuple[Reals, Reals]:
    """Return times in s (k,) and curves of a vector column (k, …), reduced like the samples."""
    t_s, values = [np.zeros(0)], [curves(np.zeros((0, *record.tables[table][column].shape)))]
    for rows in record.batches(table, ("t_ns", column)):
        part_s, part = _seconds(rows["t_ns"]), curves(rows[column])
        keep = decimate_all(part_s, part.reshape(len(part), -1), record.slice_columns)
        t_s.append(part_s[keep])
        values.append(part[keep])
    return np.concatenate(t_s), np.concatenate(values)


# States, and times of transmissions and deliveries


class Transmissions(NamedTuple):
    """The transmissions of a loop, and which of them arrived."""

    sent_s: Reals
    """(e,) times t_i of all transmissions."""
    lost: Flags
    """(e,) whether the network lost the transmission."""
    received_s: Reals
    """(d,) times t_i* of the transmissions that the controller received."""
    forced: Flags
    """(d,) whether the guarantee forced the delivery."""


def states_figure(
    mode: Literal["model", "zoh"],
    title: str,
    t_s: Reals,
    states: Sequence[Curve],
    transmissions: Transmissions,
) -> FigureDescription:
    """States, and broadcasting and receiving intervals: the paper's Fig. 2 and 3.

    Args:
        mode: ``model`` is the paper's MB-ET (Fig. 2), ``zoh`` its ZOH-ET (Fig. 3).
        title: shown after "MB-ET" or "ZOH-ET".
        t_s: the times of the run.
        states: their curves; the first 16 states are drawn.
        transmissions: what was sent and received.
    """
    by_state = [(name, [*curves]) for name, curves in groupby(states, lambda curve: curve.panel)]
    n = len(by_state)
    count = min(n, _MOST_STATES)
    # A panel for each state; below, both kinds of intervals with a common vertical axis.
    panels = [
        Panel(
            # Curves in front are thinner, so that equal curves stay visible.
            items=[_line(curve, order=2.5 - 0.1 * curve.style.width) for curve in curves],
            x=time_axis(t_s),
            y=Axis(label=label_text(name)),
            legend=() if i else None,
        )
        for i, (name, curves) in enumerate(by_state[:count])
    ]
    columns = _state_columns(count)
    times_s = transmissions.sent_s, transmissions.received_s
    between = [np.diff(times, prepend=np.nan) for times in times_s]
    highest = 1.05 * max(np.nanmax(np.append(finite(gaps), 0.0)) for gaps in between) or None
    y = Axis(label="interval [s]", ends=(0.0, highest))
    intervals = [
        Panel(
            title="Broadcasting intervals",
            items=_sent_marks(transmissions, between[0]),
            x=time_axis(t_s, numbers=False),
            y=y,
        ),
        Panel(
            title="Receiving intervals",
            items=_received_marks(transmissions, between[1]),
            x=time_axis(t_s),
            y=y,
        ),
    ]
    head = "MB-ET" if mode == "model" else "ZOH-ET"
    note = f" ({count} of {n} states)" if count < n else ""
    of_states = PanelRow(
        panels=panels,
        height_in=1.45 if count <= 2 * columns else 1.15,
        columns=columns,
        common="x",
        narrowest_in=_STATES_NARROWEST_IN,
    )
    return FigureDescription(
        name="states",
        heading=": ".join(filter(None, (head, label_text(title, _LONGEST_TITLE)))) + note,
        rows=[of_states, *(PanelRow(panels=[panel], height_in=1.2) for panel in intervals)],
    )


def _state_columns(count: int) -> int:
    """Return the number of panels side by side, for the curves of ``count`` states."""
    if count <= 3:
        return count
    if count == 4:
        return 2
    return 3 if count <= 12 else 4


def _sent_marks(transmissions: Transmissions, interval_s: Reals) -> list[Item]:
    t_s, lost = transmissions.sent_s, transmissions.lost
    arrived = Marks(x=t_s[~lost], y=interval_s[~lost], label="sent", colour=SENSOR, stems=SENSOR)
    crosses = Marks(x=t_s[lost], y=interval_s[lost], label="sent, lost", colour=LOST, stems=SENSOR)
    return [arrived, replace(crosses, marker="x", size=6.5, stroke=1.8)]


def _received_marks(transmissions: Transmissions, interval_s: Reals) -> list[Item]:
    t_s, forced = transmissions.received_s, transmissions.forced
    lost_s = transmissions.sent_s[transmissions.lost]
    dots = Marks(x=t_s[~forced], y=interval_s[~forced], label="received", colour=CONTROLLER)
    diamonds = Marks(x=t_s[forced], y=interval_s[forced], label="received, forced", colour=FORCED)
    crosses = Marks(x=lost_s, y=np.zeros(len(lost_s)), label="lost", colour=LOST, marker="x")
    return [
        replace(dots, stems=CONTROLLER),
        replace(diamonds, marker="D", size=6.0, stems=CONTROLLER),
        replace(crosses, order=3),
    ]


def _states(record: RunRecord, aligned: _Thinned) -> FigureDescription:
    outcomes, run, events = packet_outcomes(record), aligned.run, record.events()
    deliveries = record.columns(CONTROLLER_DELIVERY, "t_ns", "sequence")
    transmissions = Transmissions(
        _seconds(events["t_ns"]),
        np.isin(events["event"], outcomes.sequence[outcomes.lost]),
        _seconds(deliveries["t_ns"]),
        np.isin(deliveries["sequence"], outcomes.sequence[outcomes.fate == Fate.FORCED]),
    )
    scenario, names = record.scenario, record.loop.state_names
    known, states = "x" if scenario.coverage.knows_state else "x̂", _states_of(record, aligned)
    figure = states_figure(scenario.mode, scenario.name, _seconds(run.t_ns), states, transmissions)
    return figure.captioned(
        "States, and the times between transmissions and between deliveries: each stem is the time "
        "since the one before, so the first packet has none. "
        + scenario.protocol.states_caption.format(known=known)
        + _estimate_text(scenario)
        + "Cross: a lost packet. Diamond: a delivery that was forced by the guarantee.",
        f"Above, the states {', '.join(names)} over time, each as x, x_s and x_c. "
        f"Below, stems for {len(events)} transmissions, of which {int(transmissions.lost.sum())} were "
        f"lost, and for {len(deliveries)} deliveries, of which {int(transmissions.forced.sum())} were "
        "forced.",
    )


def _states_of(record: RunRecord, samples: _Thinned) -> list[Curve]:
    run, true_x = samples
    x, x_hat = (run.x, None) if true_x is None else (true_x, run.x)
    return state_curves(record.loop.state_names, _seconds(run.t_ns), x, run.x_s, run.x_c, x_hat)


def _errors_of(run: AlignedRun) -> list[Curve]:
    return error_curves(_seconds(run.t_ns), run.e_s_norm, run.e_c_norm, run.threshold)


def _estimate_text(scenario: Scenario) -> str:
    """Explain x̂, if the sensor does not measure x exactly."""
    if scenario.coverage.knows_state:
        return ""
    if scenario.observer is None:
        return "x̂ is the measurement, x with noise. "
    outputs = scenario.message_sizes.outputs
    return f"x̂ is the estimate of the observer, from {outputs} {'output' if outputs == 1 else 'outputs'}. "


# Norms with their bounds, and inputs


def _norms(
    name: str, title: str, lines: Sequence[Line], height_in: float, bounds: Sequence[Line] = ()
) -> FigureDescription:
    """Describe a figure of norms; its axis is limited: resets fall to rounding errors."""
    values = np.concatenate([line.y for line in lines])
    y = Axis(label="norm", logarithmic=True, about=values, decades=_DECADES)
    items = [replace(bound, opacity=_FAR_OPACITY) if _is_far(bound, lines) else bound for bound in bounds]
    panel = Panel(title=title, items=[*lines, *items], x=time_axis(lines[0].x), y=y)
    return one_panel(name, panel, height_in)


@np.errstate(all="ignore")
def _is_far(bound: Line, curves: Sequence[Line]) -> bool:
    """Whether a bound is many times larger than the curves, most of the time."""
    if not len(bound.x) or not all(len(curve.x) for curve in curves):
        return False
    at_bound = [np.interp(bound.x, curve.x, curve.y) for curve in curves]
    ratios = bound.y / np.fmax.reduce(at_bound)
    finite_ratios = ratios[np.isfinite(ratios)]
    return len(finite_ratios) > 0 and bool(np.median(finite_ratios) > _FAR_RATIO)


def _errors(scenario: Scenario, run: AlignedRun, bounds: list[Line]) -> FigureDescription:
    lines = [_line(curve) for curve in _errors_of(run)]
    relative = " Both are relative to x̂, the sensor's estimate of x."
    return _norms("errors", "Error norms", lines, 2.7, bounds).captioned(
        scenario.protocol.error_caption
        + ("" if scenario.coverage.knows_state else relative)
        + _dashed(bounds),
        "Error norms over time on a logarithmic axis: "
        f"‖e_s‖ up to {largest_text(run.e_s_norm)}, ‖e_c‖ up to {largest_text(run.e_c_norm)}.",
    )


def _state_norm(record: RunRecord, bounds: list[Line]) -> FigureDescription:
    t_s, norm = _decimated(record, PLANT_STEP, "x", row_norms)
    line = _line(norm_curve(t_s, norm))
    ends = f", from {norm[0]:.3g} to {norm[-1]:.3g}" if len(norm) else ""
    return _norms("state-norm", "Norm of the state", [line], 2.1, bounds).captioned(
        "Norm of the plant's state." + _dashed(bounds),
        f"Norm of the state over time on a logarithmic axis{ends}.",
    )


def _input(record: RunRecord) -> FigureDescription:
    """Describe the inputs, each of which is held until the next."""
    names, table = record.loop.input_names, CONTROLLER_STEP
    title, caption = "Control input $u = K x_c$", "Control input u = K x_c, held between ticks."
    if record.scenario.controller.update_timeout_s is not None:
        title, caption = "Control input", "Input that the controller sends, held between ticks."
    if record.scenario.network.actuation is not None:
        table, title = PLANT_STEP, "Applied input"
        caption = "Input that the plant applied, also while actuations were missing."
    t_s, u = _decimated(record, table, "u")
    lines = [replace(_line(curve), label=label_text(curve.name)) for curve in input_curves(names, t_s, u)]
    panel = Panel(title=title, items=lines, x=time_axis(t_s), y=Axis(label="input"))
    return one_panel("input", panel, 1.7).captioned(
        f"{caption} Equal inputs are drawn one inside the other.",
        f"Control inputs {', '.join(names)} over time.",
    )


def _dashed(curves: Sequence[Line]) -> str:
    if not curves:
        return ""
    return f" Dashed: claimed bounds; a pale one is mostly over {_FAR_RATIO:g} times the curves."


def _seconds(t_ns: NDArray[np.int64]) -> Reals:
    return np.asarray(t_ns / NS_PER_S, dtype=np.float64)


def _losses(record: RunRecord) -> FigureDescription:
    """Describe the losses that occurred, beside what the guarantee allows."""
    outcomes, network = packet_outcomes(record), record.scenario.network
    bursts, longest = outcomes.loss_bursts(), network.longest_burst
    title, consecutive, actuation_text = "Consecutive losses", "consecutive losses", ""
    panels = [_loss_panel(title, consecutive, "bursts", bursts, longest)]
    for rule in network.guarantee.rules[:3]:
        if isinstance(rule, LossesInWindow):
            title = f"Losses in {rule.window} updates"
            label = f"losses in {rule.window} consecutive updates"
            counts = outcomes.losses_in(rule.window)
            panels.append(_loss_panel(title, label, "positions", counts, rule.limit))
    if (actuation := network.actuation) is not None:
        lost = packet_outcomes(record, Flow.ACTUATION).loss_bursts()
        limit, label = actuation.link.longest_burst, "consecutive lost actuations"
        panels.append(_loss_panel("Of actuations", label, "bursts", lost, limit))
        actuation_text = " Last panel: the same of actuations."
    narrowest_in, widest_in = _LOSSES_NARROWEST_IN, _LOSSES_WIDEST_IN
    row = PanelRow(panels=panels, height_in=1.9, narrowest_in=narrowest_in, widest_in=widest_in)
    limit_name = "the guarantee" if network.enforce_mansd else "the assumption (not enforced)"
    return FigureDescription(name="losses", rows=[row]).captioned(
        "Effective losses of updates: dropped, corrupted, or delivered out of order. "
        f"Dashed: the largest number that {limit_name} allows: {network.guarantee.meaning}.{actuation_text}",
        f"{len(bursts)} bursts of losses, the longest of {int(bursts.max(initial=0))}; at most "
        f"{longest} consecutive losses are allowed.",
    )


def _loss_panel(title: str, label: str, counted: str, values: NDArray[np.int64], limit: int | None) -> Panel:
    """Describe a histogram of whole numbers (k,), and the largest number that is allowed.

    A limit that is far beyond all numbers is in the label only: beside it no bar could be seen.
    """
    counts = Counter(values.tolist())
    low, high = min([1, *counts]), max([1, *counts])
    if limit is not None and limit > max(_NEAR_LIMIT, _NEAR_LIMIT_RATIO * high):
        label, limit = f"{label} (allowed: {limit:,})", None
    high = max(high, limit or 1)
    bars = Bars(
        edges=np.arange(low, high + 2) - 0.5,
        heights=np.array([counts[number] for number in range(low, high + 1)], np.float64),
        colour=LOST,
        share=0.8,
        numbers=len(counts) <= _MOST_NUMBERED_BARS,
    )
    items: list[Item] = [bars]
    if limit is not None:
        items.append(Rule(at=limit + 0.5, colour=palette.CERTIFIED, vertical=True))
    x = Axis(label=label, ends=(low - 0.6, high + 0.9), whole=True, grid=False)
    y = Axis(label=counted, whole=True)
    return Panel(title=title, items=items, x=x, y=y, empty="no loss")

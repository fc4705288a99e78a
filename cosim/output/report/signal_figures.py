"""The figures of a run, from plain arrays: times in seconds, one row per sample.

Every function accepts arrays of any length, including 0, and values that are not finite; none uses
pyplot. Norms are those of the run's trigger, ‖v‖ = ‖W v‖₂. In every figure, grey is the plant, blue
the sensor, orange the controller; dashed curves are certified bounds.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cosim.analysis.fidelity import Fidelity
from cosim.analysis.value_reduction import QuantileSketch, Reals
from cosim.output import palette
from cosim.output.report import axes as draw
from cosim.output.report.figure_style import PAPER, NotebookFigure, printed, styled

Flags = NDArray[np.bool_]

_PLANT, _SENSOR, _CONTROLLER = map(printed, (palette.PLANT, palette.SENSOR, palette.CONTROLLER))
_THRESHOLD, _FORCED, _LOST = map(printed, (palette.THRESHOLD, palette.FORCED, palette.LOST))
_ERRORS = (r"$\|e_c\|$ controller", r"$\|e_s\|$ sensor", "threshold")
_STATE = r"$\|x\|$ plant"
_STATES = ("$x$ plant", "$x_s$ sensor", "$x_c$ controller", r"$\hat{x}$ sensor")
_SENT = ("sent", "sent, lost")
_RECEIVED = ("received", "received, forced", "lost")
_PERIOD = "one period"
_NARROWEST_IN = 1.7
"""Least width of a state's panel with its labels."""
_MOST_STATES = 16
_LONGEST_TITLE = 40
_DECADES = 6
_RANKS = 120
_SHORTEST_US = 0.1  # a logarithmic axis has no zero
_DASHES: tuple[Any, ...] = ("-", (0, (6, 1.5)), (0, (2, 1.2)), (0, (6, 1.5, 1.5, 1.5)))


@styled
def paper_figure(
    *,
    mode: Literal["model", "zoh"],
    t_s: Reals,
    x: Reals,
    x_s: Reals,
    x_c: Reals,
    state_names: Sequence[str],
    broadcast_s: Reals,
    dropped: Flags,
    received_s: Reals,
    forced: Flags,
    title: str = "",
    x_hat: Reals | None = None,
) -> Figure:
    """States, and broadcasting and receiving intervals: the paper's Fig. 2 and 3.

    Args:
        mode: ``model`` is the paper's MB-ET (Fig. 2), ``zoh`` its ZOH-ET (Fig. 3).
        t_s: (k,) times of the samples.
        x: (k, n) the plant's state.
        x_s: (k, n) the sensor's model.
        x_c: (k, n) the controller's model; NaN where unknown.
        state_names: n names; the first 16 states are drawn.
        broadcast_s: (e,) times t_i of all transmissions.
        dropped: (e,) whether the network lost the transmission.
        received_s: (d,) times t_i* of the transmissions that the controller received.
        forced: (d,) whether the guarantee forced the delivery.
        title: title of the run, shown after "MB-ET" or "ZOH-ET".
        x_hat: (k, n) the sensor's estimate of x; None if it measures x exactly.
    """
    n = len(state_names)
    drawn = min(n, _MOST_STATES)
    labels = _STATES if x_hat is not None else _STATES[:3]
    figure, panels, above, below = _paper_panels(drawn, labels)
    for i, axes in enumerate(panels):
        known = None if x_hat is None else x_hat[:, i]
        shown = _state(axes, t_s, x[:, i], x_s[:, i], x_c[:, i], known)
        axes.set_ylabel(draw.plain(state_names[i]))
        draw.finish(axes, t_s)
    _heading(figure, mode, title, f"{drawn} of {n} states" if drawn < n else "", shown)
    _broadcasts(above, broadcast_s, dropped)
    _receptions(below, received_s, forced, broadcast_s[dropped])
    above.tick_params(labelbottom=False)
    for axes in (above, below):
        axes.set_ylabel("interval [s]")
        axes.set_ylim(bottom=0)
        draw.finish(axes, t_s)
    below.set_xlabel(draw.TIME)
    figure.align_ylabels()
    return figure


def _paper_panels(states: int, labels: Sequence[str]) -> tuple[Figure, list[Axes], Axes, Axes]:
    """Place the panels of the states, of the broadcasting and of the receiving intervals."""
    space = draw.layout()
    columns = states if states <= 3 else 2 if states == 4 else 3 if states <= 12 else 4
    columns = min(columns, int(space.width_in / _NARROWEST_IN))
    rows = math.ceil(states / columns)
    height_in, interval_in = (space.scale * one for one in (1.45 if rows <= 2 else 1.15, 1.2))
    width_in = (space.width_in - space.right_in) / columns - space.left_in
    # If the last row is not full, the time axes of the row above need room for their numbers.
    last_in = space.gap_in if states % columns == 0 else space.below_in
    gaps_in = [space.gap_in] * (rows - 2) + [last_in] * (rows > 1)
    head_in = draw.head_in(labels)
    tops_in = [head_in + i * height_in + sum(gaps_in[:i]) for i in range(rows)]
    above_in = tops_in[-1] + height_in + space.below_in + draw.head_in(_SENT)
    below_in = above_in + interval_in + draw.head_in(_RECEIVED)
    figure = NotebookFigure(figsize=(space.width_in, below_in + interval_in + space.below_in))
    panels = []
    for i in range(states):
        row, column = divmod(i, columns)
        left_in = space.left_in + column * (space.left_in + width_in)
        axes = draw.place(figure, left_in, tops_in[row], width_in, height_in)
        axes.tick_params(labelbottom=i + columns >= states)
        axes.set_xlabel(draw.TIME if i + columns >= states else "")
        panels.append(axes)
    whole_in = draw.panel_width_in()
    above = draw.place(figure, space.left_in, above_in, whole_in, interval_in)
    below = draw.place(
        figure, space.left_in, below_in, whole_in, interval_in, sharex=above, sharey=above
    )
    return figure, panels, above, below


def _state(
    axes: Axes, t_s: Reals, x: Reals, x_s: Reals, x_c: Reals, x_hat: Reals | None
) -> list[draw.Shown]:
    """Draw one state; later curves are thinner, so that equal curves stay visible."""
    plant = draw.line(axes, t_s, draw.finite(x), "$x$ plant", color=_PLANT, linewidth=4.2)
    controller = draw.line(
        axes, t_s, draw.finite(x_c), "$x_c$ controller", color=_CONTROLLER, linewidth=2.4
    )
    sensor = draw.line(axes, t_s, draw.finite(x_s), "$x_s$ sensor", color=_SENSOR, linewidth=1.3)
    known: list[draw.Shown] = []
    if x_hat is not None:
        style: dict[str, Any] = {"color": _SENSOR, "linewidth": 1.0, "linestyle": (0, (1, 1))}
        known = draw.line(axes, t_s, draw.finite(x_hat), r"$\hat{x}$ sensor", **style)
    return [*plant, *known, *sensor, *controller]


def _heading(figure: Figure, mode: str, title: str, note: str, shown: Sequence[draw.Shown]) -> None:
    """Write title and legend above all states."""
    head = "MB-ET" if mode == "model" else "ZOH-ET"
    text = ": ".join(filter(None, (head, draw.plain(title, _LONGEST_TITLE)))) + (
        f" ({note})" if note else ""
    )
    space, height_in = draw.layout(), figure.get_figheight()
    left, y = space.left_in / space.width_in, 1 - 0.26 * space.above_in / height_in
    figure.text(left, y, text, weight="bold", size=space.title_pt, va="top")
    handles, labels = zip(*shown, strict=True)
    top_in = (0.18 if space.beside_title else 0.9) * space.above_in
    corner = (1 - space.right_in / space.width_in, 1 - top_in / height_in)
    columns = len(labels) if space.beside_title else draw.legend_columns(labels)
    figure.legend(handles, labels, loc="upper right", bbox_to_anchor=corner, ncols=columns)


def _broadcasts(axes: Axes, t_s: Reals, dropped: Flags) -> None:
    interval_s = _intervals(t_s)
    draw.stems(axes, t_s, interval_s, color=_SENSOR)
    lost: dict[str, Any] = {"color": _LOST, "marker": "x", "size": 6.5, "markeredgewidth": 1.8}
    shown = draw.marks(axes, t_s[~dropped], interval_s[~dropped], "sent", color=_SENSOR, marker="o")
    shown += draw.marks(axes, t_s[dropped], interval_s[dropped], "sent, lost", **lost)
    axes.set_title("Broadcasting intervals")
    draw.legend(axes, shown)


def _receptions(axes: Axes, t_s: Reals, forced: Flags, dropped_s: Reals) -> None:
    interval_s = _intervals(t_s)
    draw.stems(axes, t_s, interval_s, color=_CONTROLLER)
    diamond: dict[str, Any] = {"color": _FORCED, "marker": "D", "size": 6.0}
    lost: dict[str, Any] = {"color": _LOST, "marker": "x", "size": 5.0, "zorder": 3}
    free = ~forced
    shown = draw.marks(axes, t_s[free], interval_s[free], "received", color=_CONTROLLER, marker="o")
    shown += draw.marks(axes, t_s[forced], interval_s[forced], "received, forced", **diamond)
    shown += draw.marks(axes, dropped_s, np.zeros(len(dropped_s)), "lost", **lost)
    axes.set_title("Receiving intervals")
    draw.legend(axes, shown)


def _intervals(t_s: Reals) -> Reals:
    """Return the times since the previous event, NaN for the first, (k,)."""
    return np.diff(t_s, prepend=np.nan)


@styled
def error_figure(
    t_s: Reals,
    e_s_norm: Reals,
    threshold: Reals,
    e_c_norm: Reals,
    envelopes: Sequence[draw.Bound] = (),
) -> Figure:
    """‖e_s‖ with its threshold, and ‖e_c‖ with its bounds, on a logarithmic axis.

    Args:
        t_s: (k,) times of the samples.
        e_s_norm: (k,) ‖x_s − x‖ before a reset, as the trigger tested it.
        threshold: (k,) threshold of the trigger.
        e_c_norm: (k,) ‖x_c − x‖; NaN where unknown.
        envelopes: certified bounds on ‖e_c‖.
    """
    labels = [*_ERRORS, *(label for label, *_ in envelopes)]
    figure, (axes,) = draw.single(2.7, labels)
    draw.logarithmic(axes, "y")
    shown = []
    for label, values, colour, width in zip(
        _ERRORS,
        (e_c_norm, e_s_norm, threshold),
        (_CONTROLLER, _SENSOR, _THRESHOLD),
        (2.6, 1.1, 1.8),
        strict=True,
    ):
        style = {"color": colour, "linewidth": width}
        shown += draw.line(axes, t_s, draw.for_log_axis(values), label, **style)
    shown += draw.bounds(axes, envelopes)
    measured = np.concatenate([e_s_norm, e_c_norm, threshold])
    return _norms(figure, axes, t_s, measured, "Error norms", shown)


@styled
def state_norm_figure(t_s: Reals, x_norm: Reals, envelopes: Sequence[draw.Bound] = ()) -> Figure:
    """‖x‖ with its bounds, on a logarithmic axis.

    Args:
        t_s: (k,) times of the samples.
        x_norm: (k,) ‖x‖.
        envelopes: certified bounds on ‖x‖.
    """
    figure, (axes,) = draw.single(2.1, [_STATE, *(label for label, *_ in envelopes)])
    draw.logarithmic(axes, "y")
    style = {"color": _PLANT, "linewidth": 2.4}
    shown = draw.line(axes, t_s, draw.for_log_axis(x_norm), _STATE, **style)
    shown += draw.bounds(axes, envelopes)
    return _norms(figure, axes, t_s, x_norm, "Norm of the state", shown)


def _norms(
    figure: Figure, axes: Axes, t_s: Reals, measured: Reals, title: str, shown: list[Any]
) -> Figure:
    """Label a figure of norms, and limit its axis: resets fall to rounding errors."""
    axes.set(title=title, xlabel=draw.TIME, ylabel="norm")
    draw.legend(axes, shown)
    draw.finish(axes, t_s)
    draw.limit_log_axis(axes, measured, _DECADES)
    return figure


@styled
def input_figure(
    t_s: Reals, u: Reals, input_names: Sequence[str], title: str = "Control input"
) -> Figure:
    """Control inputs; each is held until the next.

    Args:
        t_s: (k,) times from which each input is held.
        u: (k, m) inputs.
        input_names: m names.
        title: of the figure.
    """
    m = len(input_names)
    names = [draw.plain(name) for name in input_names]
    figure, (axes,) = draw.single(1.7, names)
    shown = []
    for i, name in enumerate(names):
        style = {
            "color": printed(palette.SERIES[i % len(palette.SERIES)]),
            "linestyle": _DASHES[i // len(palette.SERIES) % len(_DASHES)],
            # Inputs often coincide: the first ones are wider, and stay visible under the last.
            "linewidth": 1.3 + 2.6 * (m - 1 - i) / m,
            "drawstyle": "steps-post",
        }
        shown += draw.line(axes, t_s, draw.finite(u[:, i]), name, **style)
    axes.set(title=title, xlabel=draw.TIME, ylabel="input")
    draw.legend(axes, shown)
    draw.finish(axes, t_s)
    return figure


@styled
def lateness_figure(
    lateness_us: Mapping[str, QuantileSketch], period_us: float | None = None
) -> Figure:
    """Share of steps with at least a given lateness, per process.

    Args:
        lateness_us: by process, the lateness of its steps in wall µs.
        period_us: the plant's period in wall µs, beyond which a step counts as late.
    """
    figure, (axes,) = draw.single(2.5, [*lateness_us, _PERIOD])
    draw.logarithmic(axes, "x")
    draw.logarithmic(axes, "y")
    shown = []
    for i, (process, late_us) in enumerate(lateness_us.items()):
        colour = palette.PROCESSES.get(process, palette.SERIES[i % len(palette.SERIES)])
        style = {"color": printed(colour), "linestyle": _DASHES[i % len(_DASHES)], "linewidth": 1.8}
        (drawn,) = axes.plot(*_later_than(late_us), drawstyle="steps-pre", **style)
        shown.append((drawn, draw.plain(process)))
    draw.finish(axes)
    if period_us is not None:
        rule = axes.axvline(period_us, color=_THRESHOLD, linewidth=1.2, linestyle=(0, (4, 3)))
        shown.append((rule, _PERIOD))
    axes.set(
        title="Lateness", xlabel="lateness [wall µs]", ylabel="share of steps at least as late"
    )
    draw.legend(axes, shown)
    return figure


def _later_than(values: QuantileSketch) -> tuple[Reals, Reals]:
    """Return values in ascending order, and for each the share of values at least as large."""
    k = values.count
    if not k:
        return np.zeros(0), np.zeros(0)
    # k values are at least as large as the k-th largest. The same number of points in each decade
    # of shares, and linearly spaced ones, which resolve the median.
    rank = np.concatenate([np.geomspace(1, k, _RANKS), np.linspace(1, k, _RANKS)])
    rank = np.unique(rank.round().astype(np.intp))[::-1]
    return np.maximum(draw.finite(values.largest(rank)), _SHORTEST_US), rank / k


@styled
def latency_figure(t_s: Reals, latency_us: Reals, until_s: float | None = None) -> Figure:
    """Sensor-to-controller latency over time, with a histogram.

    Args:
        t_s: (d,) event times of the updates that arrived.
        latency_us: (d,) wall µs from the event to the controller's update.
        until_s: end of the time axis; by default the last event.
    """
    titles = {"title": "Sensor-to-controller latency", "ylabel": "latency [wall µs]"}
    return _over_time(t_s, latency_us, _CONTROLLER, [], until_s, titles)


@styled
def fidelity_figure(found: Fidelity) -> Figure:
    """Change of x by each effect, over time: ‖x_(with the effect) − x_(without)‖."""
    names = [stage.name for stage in found.stages]
    figure, (axes,) = draw.single(2.7, names)
    draw.logarithmic(axes, "y")
    shown = []
    for i, (name, norms) in enumerate(zip(names, found.stage_norms, strict=True)):
        style = {"color": printed(palette.SERIES[i]), "linestyle": _DASHES[i], "linewidth": 1.6}
        shown += draw.line(axes, found.t_s, draw.for_log_axis(norms), name, **style)
    title = f"{draw.plain(found.scenario, _LONGEST_TITLE)}: effects on x"
    return _norms(figure, axes, found.t_s, found.stage_norms, title, shown)


@styled
def inter_event_figure(
    broadcast_s: Reals, lower_bounds: Sequence[draw.Bound] = (), until_s: float | None = None
) -> Figure:
    """Inter-event times t_i − t_{i−1} over time, with a histogram.

    Args:
        broadcast_s: (e,) times t_i of all transmissions.
        lower_bounds: bounds on the inter-event time, certified or from the paper's formula.
        until_s: end of the time axis; by default the last event.
    """
    intervals_s = np.diff(broadcast_s)
    titles = {"title": "Inter-event times", "ylabel": "inter-event time [s]"}
    return _over_time(broadcast_s[1:], intervals_s, _SENSOR, lower_bounds, until_s, titles)


def _over_time(
    t_s: Reals,
    values: Reals,
    colour: Any,
    lower_bounds: Sequence[draw.Bound],
    until_s: float | None,
    titles: Mapping[str, str],
) -> Figure:
    """Draw values over time, and their histogram on the same logarithmic axis."""
    values = draw.finite(values, positive=True)
    figure, (axes, beside) = draw.single(2.1, [label for label, *_ in lower_bounds], beside_in=2.0)
    draw.logarithmic(axes, "y")
    shown = draw.bounds(axes, lower_bounds)
    draw.marks(
        axes, t_s, values, color=colour, marker="o", markeredgecolor=PAPER, markeredgewidth=0.5
    )
    axes.set(xlabel=draw.TIME, **titles)
    draw.legend(axes, shown)
    seen = values[np.isfinite(values)]
    if len(seen):
        low, high = math.log10(seen.min()), math.log10(seen.max())
        margin = max(0.05 * (high - low), 0.02)
        bins = np.logspace(low - margin, high + margin, 31).tolist()
        beside.hist(seen, bins, orientation="horizontal", color=colour, rwidth=0.9)
    draw.finish(axes, None if until_s is None else np.array([0.0, t_s.max(initial=until_s)]))
    draw.finish(beside)
    for bound, style in zip(lower_bounds, draw.bound_styles(lower_bounds), strict=True):
        if len(bound.values):
            beside.axhline(float(np.min(bound.values)), **style)
    beside.set_xlabel("count")
    beside.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))
    return figure

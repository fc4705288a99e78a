"""The figures of loops that share a network: the network, the errors and states of all loops."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cosim.analysis.network_summary import LoopsOverTime, loops_over_time, quantiles
from cosim.analysis.summary_model import RunSummary
from cosim.output import palette
from cosim.output.report import axes as draw
from cosim.output.report.figure_style import NotebookFigure, printed, styled
from cosim.output.report.run_figures import RunFigure
from cosim.record.run_record import RecordedRun
from noack.core.number_format import number

NAMED = len(palette.SERIES)
"""Up to so many loops have a curve each, in a colour of its own; more are drawn as bands."""
_PANEL_IN, _BETWEEN_IN = 1.7, 0.35
_ROW_IN, _LOWEST_IN, _HIGHEST_IN, _BAR_IN = 0.22, 1.2, 4.5, 0.2
_BAR_ROOM_IN = 4 * _BAR_IN
_DECADES = 5
MOST_ROWS = 24
"""Up to so many rows of the map have the names of their loops."""
_BANDS = ((0, 4, 0.25, "5 to 95 % of the loops"), (1, 3, 0.45, "25 to 75 %"))
_MEDIAN, _LARGEST = 2, 5
_MOST, _MEAN = "largest of an interval", "mean"

Reals = NDArray[np.float64]
Bools = NDArray[np.bool_]


class QueueLength(NamedTuple):
    """Datagrams inside the network in intervals of equal width."""

    width_s: float
    mean: Sequence[float]
    largest: Sequence[int]


@styled
def network_figure(over_time: LoopsOverTime, names: Sequence[str], queue: QueueLength) -> Figure:
    """Draw the number of datagrams in the network, and the share of each loop of the bytes."""
    figure, (upper, lower) = _two_panels((_MOST, _MEAN), _labels(names))
    t_s = np.asarray((np.arange(len(queue.mean)) + 0.5) * queue.width_s, np.float64)
    network, most = printed(palette.NETWORK), np.asarray(queue.largest, dtype=np.float64)
    upper.fill_between(t_s, most, step="mid", color=network, alpha=0.3, linewidth=0)
    shown = draw.line(upper, t_s, np.array(queue.mean, np.float64), _MEAN, color=network)
    upper.set(title="Datagrams in the network", ylabel="datagrams")
    draw.legend(upper, [(upper.collections[0], _MOST), *shown])
    ends_s, shares = over_time.shares()
    lower.set(title="Share of the link", ylabel="%", xlabel=draw.TIME)
    _curves(lower, ends_s - ends_s[0] / 2, 100 * shares, names)
    for axes in (upper, lower):
        axes.set_ylim(bottom=0)
        draw.finish(axes, over_time.edges_s)
    return figure


@styled
def norms_figure(over_time: LoopsOverTime, names: Sequence[str], stayed: Bools) -> Figure:
    """Draw ‖e_c‖ and ‖x‖ of all loops on logarithmic axes, whose range is for those that stayed."""
    figure, panels = _two_panels(_labels(names), _labels(names))
    drawn = ((r"$\|e_c\|$ controller", over_time.errors), (r"$\|x\|$ plant", over_time.states))
    for axes, (label, values) in zip(panels, drawn, strict=True):
        draw.logarithmic(axes, "y")
        axes.set(title=label)
        _curves(axes, over_time.middles_s, draw.finite(values, positive=True), names)
        draw.limit_log_axis(axes, _scale(values, stayed), _DECADES)
        draw.finish(axes, over_time.edges_s)
    panels[1].set_xlabel(draw.TIME)
    return figure


@styled
def error_map(over_time: LoopsOverTime, names: Sequence[str], stayed: Bools) -> Figure:
    """Draw ‖e_c‖ of each loop, a row, over time, as colours, whose range is for those that stayed.

    Args:
        over_time: the errors.
        names: of the loops.
        stayed: (L,) the loops that did not diverge.
    """
    count = len(names)
    space, above_in = draw.layout(), draw.head_in([])
    height_in = min(max(count * _ROW_IN, _LOWEST_IN), _HIGHEST_IN) * space.scale
    figure = NotebookFigure(figsize=(space.width_in, above_in + height_in + space.below_in))
    shown = [draw.plain(name) for name in names] if count <= MOST_ROWS else []
    names_in = max(map(len, shown), default=0) * space.character_in + _BAR_IN
    left_in = max(space.left_in, names_in)
    width_in = space.width_in - left_in - space.right_in - _BAR_ROOM_IN
    axes = draw.place(figure, left_in, above_in, width_in, height_in)
    values = draw.finite(over_time.errors, positive=True)
    axes.set(title=r"$\|e_c\|$ of each loop", xlabel=draw.TIME)
    axes.grid(visible=False)
    if shown:
        axes.set_yticks(range(count), shown)
    else:
        axes.set_ylabel("number of the loop")
    if not np.isfinite(values).any():
        draw.finish(axes)
        return figure
    measured = _scale(values, stayed)
    most = float(np.nanmax(measured))
    least = max(float(np.nanmin(measured)), most / 10**_DECADES)
    values[over_time.errors == 0] = least  # just after an update
    norm = LogNorm(least, most if most > least else 2 * least)
    image = axes.imshow(
        values, aspect="auto", interpolation="nearest", norm=norm, cmap=colormaps["viridis"],
        extent=(0.0, float(over_time.edges_s[-1]), count - 0.5, -0.5),
    )  # fmt: skip
    bar_in = space.width_in - space.right_in - 3 * _BAR_IN
    bar = draw.place(figure, bar_in, above_in, _BAR_IN, height_in)
    figure.colorbar(image, cax=bar, extend="max" if float(np.nanmax(values)) > most else "neither")
    bar.grid(visible=False)
    return figure


def _scale(values: Reals, stayed: Bools) -> Reals:
    """Return the values of the loops that did not diverge; if none is known, of all."""
    measured = values[stayed]
    return measured if np.isfinite(measured).any() else values


def _labels(names: Sequence[str]) -> list[str]:
    """Return the labels of the curves, for the room of the legend."""
    bands = [*(label for *_, label in _BANDS), "median", "largest"]
    return [draw.plain(name) for name in names] if len(names) <= NAMED else bands


def _two_panels(*labels: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Return a figure of two panels, whose legends have these labels."""
    space, (upper_in, lower_in) = draw.layout(), map(draw.head_in, labels)
    panel_in, between_in = _PANEL_IN * space.scale, _BETWEEN_IN * space.scale
    below_in = upper_in + panel_in + between_in + lower_in
    height_in = below_in + panel_in + space.below_in
    figure = NotebookFigure(figsize=(space.width_in, height_in))
    at_in = ((space.left_in, upper_in), (space.left_in, below_in))
    width_in = draw.panel_width_in()
    return figure, [draw.place(figure, *one_in, width_in, panel_in) for one_in in at_in]


def _curves(axes: Axes, t_s: Reals, values: Reals, names: Sequence[str]) -> None:
    """Draw a curve for each of a few loops, (L, k) over (k,), or quantiles over many."""
    shown: list[draw.Shown] = []
    if len(names) <= NAMED:
        for name, colour, curve in zip(names, palette.SERIES, values, strict=False):
            shown += draw.line(axes, t_s, curve, draw.plain(name), color=printed(colour))
    else:
        found, orange = quantiles(values), printed(palette.CONTROLLER)
        for low, high, alpha, label in _BANDS:
            band = axes.fill_between(
                t_s, found[low], found[high], color=orange, alpha=alpha, linewidth=0
            )
            shown.append((band, label))
        shown += draw.line(axes, t_s, found[_MEDIAN], "median", color=orange)
        dashed = {"color": printed(palette.LOST), "linestyle": (0, (3, 1.5)), "linewidth": 1.0}
        shown += draw.line(axes, t_s, found[_LARGEST], "largest", **dashed)
    draw.legend(axes, shown)


def network_pictures(run: RecordedRun, summary: RunSummary) -> dict[str, RunFigure]:
    """Draw the figures of all loops, by name.

    Raises:
        CallerError: a table of the record is damaged.
    """
    figures = _figures(loops_over_time(run), summary)
    return {figure.name: figure for figure in figures}


def _figures(over_time: LoopsOverTime, summary: RunSummary) -> list[RunFigure]:
    names = [loop.name for loop in summary.loops]
    flying = summary.network.in_flight
    queue = QueueLength(flying.width_s, flying.mean_by_interval, flying.max_by_interval)
    drawn = (
        "Each loop has a curve."
        if len(names) <= NAMED
        else "Bands: quantiles over the loops; dashed: the largest value."
    )
    stayed = np.array([loop.diverged_at_s is None for loop in summary.loops])
    left = "" if stayed.all() else " A loop that diverged leaves the range of the axis."
    order = "" if len(names) <= MOST_ROWS else " Loops are numbered from 0, as in the scenario."
    largest = over_time.errors[np.isfinite(over_time.errors)].max(initial=0.0)
    return [
        RunFigure(
            "network", network_figure(over_time, names, queue),
            "Above: datagrams that wait, are sent or are delayed in the network. Below: each "
            f"loop's share of the bytes that left it. {drawn}",
            f"Above, the number of datagrams in the network over time, up to {flying.max}. "
            f"Below, the shares of {len(names)} loops in the bytes that the network forwarded.",
        ),
        RunFigure(
            "loops", norms_figure(over_time, names, stayed),
            "Largest error ‖e_c‖ of the controller's model, and largest norm ‖x‖ of the plant's "
            f"state, in each of {len(over_time.middles_s)} intervals. {drawn}{left}",
            f"Norms of {len(names)} loops over time on logarithmic axes; ‖e_c‖ is at most "
            f"{number(largest)}.",
        ),
        RunFigure(
            "map", error_map(over_time, names, stayed),
            "Largest ‖e_c‖ of each loop in each interval; no colour before its first delivery."
            f"{order}",
            f"A row of colours for each of {len(names)} loops: ‖e_c‖ over time.",
        ),
    ]  # fmt: skip

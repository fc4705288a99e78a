"""The figures of a run's page: those of loops that share a network, or those of its only loop."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.loops_over_time import LoopOverTime, LoopsOverTime, loops_over_time, quantiles
from cosim.analysis.summary.summary_model import InFlightPart, RunSummary
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import (
    draw_band,
    draw_line,
    label_text,
    limit_decades,
    name_ticks,
    set_times,
)
from cosim.output.figures.page_figure import PageFigure
from cosim.output.figures.panels import Panels, add_colour_bar, labels_in
from cosim.output.figures.run_figures import envelopes, run_figures
from cosim.record.align import Reals
from cosim.record.run_record import RecordedRun
from netem.core.number_format import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Bools = NDArray[np.bool_]

MOST_CURVES = len(palette.SERIES)
"""Largest number of loops with a curve each, in its own colour; more are drawn as bands."""
_PANEL_IN = 1.7
_ROW_IN, _LOWEST_IN, _HIGHEST_IN = 0.22, 1.2, 4.5
"""Height of a row of the map, and limits of the height of the map."""
_DECADES = 5
"""Maximum decades of norms that are shown."""
_MOST_NAMED_ROWS = 24
"""Largest number of rows of the map that have the names of their loops."""
_BANDS = ((0, 4, 0.25, "5 to 95 % of the loops"), (1, 3, 0.45, "25 to 75 %"))
"""Indices of two quantiles in QUANTILES, opacity and label of the band between them."""
_MEDIAN, _LARGEST = 2, 5
"""Their places among QUANTILES."""


def page_figures(
    run: RecordedRun,
    summary: Callable[[], RunSummary],
    loop: str | None = None,
    *,
    bounded: bool = True,
) -> Mapping[str, Callable[[], PageFigure]]:
    """Return functions that return the figures of a run's page, or of a loop's, by name.

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


def network_figures(
    run: RecordedRun, summary: RunSummary, over_time: Sequence[LoopOverTime] | None = None
) -> list[PageFigure]:
    """Return the figures of all loops; ``over_time`` is how each loop went, if that is known.

    Raises:
        CallerError: a table of the record is damaged.
    """
    together = loops_over_time(run, over_time)
    names = [label_text(loop.name) for loop in summary.loops]
    is_bounded = np.array([loop.diverged_at_s is None for loop in summary.loops])
    in_flight = summary.network.in_flight
    curves = "Each loop has a curve."
    if len(names) > MOST_CURVES:
        curves = "Bands: quantiles over the loops; dashed: the largest value."
    diverged = "" if is_bounded.all() else " A loop that diverged leaves the range of the axis."
    order = "" if len(names) <= _MOST_NAMED_ROWS else " Loops are numbered from 0, as in the scenario."
    largest = together.errors[np.isfinite(together.errors)].max(initial=0.0)
    return [
        PageFigure(
            name="network",
            draw_panels=lambda figure: draw_link(figure, together, names, in_flight),
            caption="Above: datagrams that wait, are sent or are delayed in the network. Below: "
            f"each loop's share of the bytes that the network forwarded. {curves}",
            description=f"Above, the number of datagrams in the network over time, up to "
            f"{in_flight.max}. Below, the shares of {len(names)} loops in the bytes that the "
            "network forwarded.",
        ),
        PageFigure(
            name="loops",
            draw_panels=lambda figure: draw_norms(figure, together, names, is_bounded),
            caption="Largest error ‖e_c‖ of the controller's model, and largest norm ‖x‖ of the plant's "
            f"state, in each of {len(together.middles_s)} intervals. {curves}{diverged}",
            description=f"Norms of {len(names)} loops over time on logarithmic axes; ‖e_c‖ is at most "
            f"{number(largest)}.",
        ),
        PageFigure(
            name="map",
            draw_panels=lambda figure: draw_error_map(figure, together, names, is_bounded),
            caption="Largest ‖e_c‖ of each loop in each interval; no colour before its first delivery."
            + order,
            description=f"A row of colours for each of {len(names)} loops: ‖e_c‖ over time.",
        ),
    ]


def draw_link(
    figure: "Figure", over_time: LoopsOverTime, names: Sequence[str], in_flight: InFlightPart
) -> list[Panels]:
    """Draw the number of datagrams in the network, and the share of each loop of the bytes."""
    queue, share = figure.add_axes((0, 0, 1, 1)), figure.add_axes((0, 0, 1, 1))
    largest = np.asarray(in_flight.max_by_interval, np.float64)
    mean = np.asarray(in_flight.mean_by_interval, np.float64)
    t_s = np.asarray((np.arange(len(mean)) + 0.5) * in_flight.width_s, np.float64)
    draw_band(
        queue, t_s, np.zeros(len(t_s)), largest, palette.NETWORK,
        label="largest of an interval", alpha=0.3, step="mid",
    )  # fmt: skip
    draw_line(queue, t_s, mean, palette.NETWORK, label="mean")
    queue.set(title="Datagrams in the network", ylabel="datagrams", ylim=(0.0, None))
    ends_s, shares = over_time.shares()
    # Steps: an interval between two without traffic is visible, too.
    _draw_loops(share, ends_s - ends_s[0] / 2, 100 * shares, names, drawstyle="steps-mid")
    share.set(title="Share of the link", ylabel="%", ylim=(0.0, None))
    return _over_time(over_time, queue, share)


def draw_norms(
    figure: "Figure", over_time: LoopsOverTime, names: Sequence[str], is_bounded: Bools
) -> list[Panels]:
    """Draw ‖e_c‖ and ‖x‖ of all loops; the range of the axes is for those that stayed."""
    errors, states = figure.add_axes((0, 0, 1, 1)), figure.add_axes((0, 0, 1, 1))
    for axes, title, values in (
        (errors, r"$\|e_c\|$ controller", over_time.errors),
        (states, r"$\|x\|$ plant", over_time.states),
    ):
        axes.set(title=title, ylabel="norm", yscale="log")
        _draw_loops(axes, over_time.middles_s, values, names)
        limit_decades(axes, _not_diverged(values, is_bounded).ravel(), _DECADES)
    return _over_time(over_time, errors, states)


def _over_time(over_time: LoopsOverTime, *panels: "Axes") -> list[Panels]:
    """Place panels one above the other, with the time axis of the run."""
    for axes in panels:
        set_times(axes, over_time.edges_s, labelled=axes is panels[-1])
    return [Panels([axes], _PANEL_IN) for axes in panels]


def _draw_loops(axes: "Axes", t_s: Reals, values: Reals, names: Sequence[str], **style: Any) -> None:
    """Draw a curve for each of a few loops, (L, k) over (k,), or quantiles over many."""
    if len(names) <= MOST_CURVES:
        for name, colour, curve in zip(names, palette.SERIES, values, strict=False):
            draw_line(axes, t_s, curve, colour, label=name, **style)
        return
    levels = quantiles(values)
    for low, high, opacity, label in _BANDS:
        draw_band(axes, t_s, levels[low], levels[high], palette.CONTROLLER, label=label, alpha=opacity)
    draw_line(axes, t_s, levels[_MEDIAN], palette.CONTROLLER, label="median")
    draw_line(axes, t_s, levels[_LARGEST], palette.LOST, (3, 1.5), label="largest", linewidth=1.0)


def draw_error_map(
    figure: "Figure", over_time: LoopsOverTime, names: Sequence[str], is_bounded: Bools
) -> list[Panels]:
    """Draw ‖e_c‖ of each loop, a row, over time, as colours; an unknown error has none.

    Args:
        figure: an empty one.
        over_time: the errors.
        names: of the loops.
        is_bounded: (L,) the loops that did not diverge, to which the colours are scaled.
    """
    axes, count = figure.add_axes((0, 0, 1, 1)), len(names)
    axes.set(title=r"$\|e_c\|$ of each loop", ylim=(count - 0.5, -0.5))
    axes.grid(visible=False)
    height_in = min(max(count * _ROW_IN, _LOWEST_IN), _HIGHEST_IN)
    row = Panels([axes], height_in)
    if count <= _MOST_NAMED_ROWS:
        name_ticks(axes, "y", dict(enumerate(names)))
        row = Panels([axes], height_in, left_in=labels_in(names))
    else:
        axes.set_ylabel("number of the loop")
    values = np.where(over_time.errors > 0, over_time.errors, np.nan)
    if np.isfinite(values).any():
        bounded_values = _not_diverged(values, is_bounded)
        high = float(np.nanmax(bounded_values))
        low = max(float(np.nanmin(bounded_values)), high / 10**_DECADES)
        values[over_time.errors == 0] = low  # just after an update
        extent = (0.0, float(over_time.edges_s[-1]), count - 0.5, -0.5)
        is_exceeded = float(np.nanmax(values)) > high
        image = axes.imshow(
            values, aspect="auto", interpolation="nearest", extent=extent,
            norm="log", vmin=low, vmax=high if high > low else 2 * low,
        )  # fmt: skip
        add_colour_bar(figure, [row], image, extend="max" if is_exceeded else "neither")
    set_times(axes, over_time.edges_s)
    return [row]


def _not_diverged(values: Reals, is_bounded: Bools) -> Reals:
    """Return the values of the loops that did not diverge; if none is known, of all."""
    bounded_values = values[is_bounded]
    return bounded_values if np.isfinite(bounded_values).any() else values

"""The figures of a run's page: those of loops that share a network, or those of its only loop."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.loops_over_time import LoopOverTime, LoopsOverTime, loops_over_time, quantiles
from cosim.analysis.summary.summary_model import InFlightPart, RunSummary
from cosim.output.figures import palette
from cosim.output.figures.figure_description import (
    Axis,
    Band,
    ColourScale,
    FigureDescription,
    Heat,
    Item,
    Line,
    Panel,
    PanelRow,
    Steps,
    label_text,
    time_axis,
)
from cosim.output.figures.run_figures import envelopes, run_figures
from cosim.record.align import Reals
from cosim.record.run_record import RecordedRun
from noack.core.number_format import number

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


def network_figures(
    run: RecordedRun, summary: RunSummary, over_time: Sequence[LoopOverTime] | None = None
) -> list[FigureDescription]:
    """Describe the figures of all loops; ``over_time`` is how each loop went, if that is known.

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
        FigureDescription(
            name="network",
            rows=_link_rows(together, names, in_flight),
            caption="Above: datagrams that wait, are sent or are delayed in the network. Below: "
            f"each loop's share of the bytes that the network forwarded. {curves}",
            description=f"Above, the number of datagrams in the network over time, up to "
            f"{in_flight.max}. Below, the shares of {len(names)} loops in the bytes that the "
            "network forwarded.",
        ),
        norms_figure(together, names, is_bounded).captioned(
            "Largest error ‖e_c‖ of the controller's model, and largest norm ‖x‖ of the plant's "
            f"state, in each of {len(together.middles_s)} intervals. {curves}{diverged}",
            f"Norms of {len(names)} loops over time on logarithmic axes; ‖e_c‖ is at most {number(largest)}.",
        ),
        error_map(together, names, is_bounded).captioned(
            f"Largest ‖e_c‖ of each loop in each interval; no colour before its first delivery.{order}",
            f"A row of colours for each of {len(names)} loops: ‖e_c‖ over time.",
        ),
    ]


def _link_rows(over_time: LoopsOverTime, names: Sequence[str], in_flight: InFlightPart) -> list[PanelRow]:
    """Describe the number of datagrams in the network, and the share of each loop of the bytes."""
    largest = np.asarray(in_flight.max_by_interval, np.float64)
    mean = np.asarray(in_flight.mean_by_interval, np.float64)
    t_s = np.asarray((np.arange(len(mean)) + 0.5) * in_flight.width_s, np.float64)
    queue: list[Item] = [
        Band(x=t_s, low=np.zeros(len(t_s)), high=largest, label="largest of an interval",
             colour=palette.NETWORK, opacity=0.3, steps="mid"),
        Line(x=t_s, y=mean, label="mean", colour=palette.NETWORK),
    ]  # fmt: skip
    ends_s, shares = over_time.shares()
    return _rows(
        over_time,
        ("Datagrams in the network", queue, Axis(label="datagrams", ends=(0.0, None))),
        (
            "Share of the link",
            # Steps: an interval between two without traffic is visible, too.
            _curves(ends_s - ends_s[0] / 2, 100 * shares, names, steps="mid"),
            Axis(label="%", ends=(0.0, None)),
        ),
    )


def norms_figure(over_time: LoopsOverTime, names: Sequence[str], is_bounded: Bools) -> FigureDescription:
    """Describe ‖e_c‖ and ‖x‖ of all loops; the range of the axes is for those that stayed."""
    panels = []
    for title, values in (
        (r"$\|e_c\|$ controller", over_time.errors),
        (r"$\|x\|$ plant", over_time.states),
    ):
        about = _not_diverged(values, is_bounded).ravel()
        axis = Axis(label="norm", logarithmic=True, about=about, decades=_DECADES)
        panels.append((title, _curves(over_time.middles_s, values, names), axis))
    return FigureDescription(name="loops", rows=_rows(over_time, *panels))


def _rows(over_time: LoopsOverTime, *panels: tuple[str, Sequence[Item], Axis]) -> list[PanelRow]:
    """Return panels, one above the other, with the time axis of the run."""
    return [
        PanelRow(height_in=_PANEL_IN, panels=[
            Panel(title=title, items=items, y=y,
                  x=time_axis(over_time.edges_s, numbers=i == len(panels) - 1))
        ])
        for i, (title, items, y) in enumerate(panels)
    ]  # fmt: skip


def _curves(t_s: Reals, values: Reals, names: Sequence[str], steps: Steps = "") -> list[Item]:
    """Describe a curve for each of a few loops, (L, k) over (k,), or quantiles over many."""
    if len(names) <= MOST_CURVES:
        return [
            Line(x=t_s, y=curve, label=name, colour=colour, steps=steps)
            for name, colour, curve in zip(names, palette.SERIES, values, strict=False)
        ]
    levels = quantiles(values)
    return [
        *(
            Band(
                x=t_s,
                low=levels[low],
                high=levels[high],
                label=label,
                opacity=opacity,
                colour=palette.CONTROLLER,
            )
            for low, high, opacity, label in _BANDS
        ),
        Line(x=t_s, y=levels[_MEDIAN], label="median", colour=palette.CONTROLLER),
        Line(x=t_s, y=levels[_LARGEST], label="largest", colour=palette.LOST, width=1.0, dash=(3, 1.5)),
    ]


def error_map(over_time: LoopsOverTime, names: Sequence[str], is_bounded: Bools) -> FigureDescription:
    """Describe ‖e_c‖ of each loop, a row, over time, as colours.

    Args:
        over_time: the errors.
        names: of the loops.
        is_bounded: (L,) the loops that did not diverge, to which the colours are scaled.
    """
    count, values = len(names), np.where(over_time.errors > 0, over_time.errors, np.nan)
    scale = None
    if np.isfinite(values).any():
        bounded_values = _not_diverged(values, is_bounded)
        high = float(np.nanmax(bounded_values))
        low = max(float(np.nanmin(bounded_values)), high / 10**_DECADES)
        values[over_time.errors == 0] = low  # just after an update
        scale = ColourScale(
            low=low,
            high=high if high > low else 2 * low,
            logarithmic=True,
            exceeded=float(np.nanmax(values)) > high,
        )
    heat = Heat(values=values, x_ends=(0.0, float(over_time.edges_s[-1])), downwards=True)
    are_named = count <= _MOST_NAMED_ROWS
    panel = Panel(
        title=r"$\|e_c\|$ of each loop",
        items=[] if scale is None else [heat],
        x=replace(time_axis(over_time.edges_s), grid=False),
        y=Axis(
            label="" if are_named else "number of the loop",
            grid=False,
            ticks=dict(enumerate(names)) if are_named else None,
        ),
    )
    height_in = min(max(count * _ROW_IN, _LOWEST_IN), _HIGHEST_IN)
    rows = [PanelRow(panels=[panel], height_in=height_in)]
    return FigureDescription(name="map", rows=rows, scale=scale)


def _not_diverged(values: Reals, is_bounded: Bools) -> Reals:
    """Return the values of the loops that did not diverge; if none is known, of all."""
    bounded_values = values[is_bounded]
    return bounded_values if np.isfinite(bounded_values).any() else values

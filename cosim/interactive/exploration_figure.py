"""The figure of a run, drawn by matplotlib: for notebooks, and to be saved."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.interactive.figure_curves import (
    BAND,
    CROSS,
    CURVES,
    LOGARITHMIC,
    PANELS,
    Columns,
    Curve,
    Shown,
    legends,
    sources,
    titles,
)
from cosim.output.report import axes as draw
from cosim.output.report.figure_style import NotebookFigure, printed, styled

_PANELS_IN, _GAP_IN = 7.0, 0.2
_DECADES = 7
"""Below and above the largest value on a logarithmic axis; a bound may be far above the run."""
_BAND_OPACITY = 0.22
_DASHES = {"solid": "-", "dashed": "--", "dotted": ":"}
_MARKS: dict[str, Any] = {CROSS: {"marker": "x", "markeredgewidth": 1.6}}
_DOT: dict[str, Any] = {"marker": "o"}
_POINTS_PER_PIXEL = 0.75


@styled
def exploration_figure(shown: Shown) -> Figure:
    """Draw the four panels of a run with all that is known of it."""
    points = sources(shown)
    named = legends(points)
    space = draw.layout()
    head_in = draw.head_in([name for names in named.values() for name in names][:1]) + _GAP_IN
    height_in = len(PANELS) * head_in + _PANELS_IN + space.below_in
    figure = NotebookFigure(figsize=(space.width_in, height_in))
    top_in, width_in = 0.0, draw.panel_width_in()
    first: Axes | None = None
    for (panel, share), title in zip(PANELS.items(), titles(shown), strict=True):
        top_in += head_in
        axes = draw.place(figure, space.left_in, top_in, width_in, share * _PANELS_IN, sharex=first)
        top_in += share * _PANELS_IN
        first = first or axes
        axes.set_title(title)
        _draw_panel(axes, panel, points, named.get(panel, []))
        axes.tick_params(labelbottom=panel == list(PANELS)[-1])
    axes.set_xlabel(draw.TIME)
    axes.set_xlim(0.0, shown.run.scenario.horizon_s)
    return figure


def _draw_panel(axes: Axes, panel: str, points: dict[str, Columns], names: list[str]) -> None:
    if panel in LOGARITHMIC:
        draw.logarithmic(axes, "y")
    drawn: dict[str, draw.Shown] = {}
    for curve in CURVES:
        if curve.panel == panel:
            for one in _draw_curve(axes, curve, points[curve.source]):
                drawn.setdefault(curve.name, one)
    if panel in LOGARITHMIC:
        measured = [points["run"][name] for name in _measured(panel)]
        draw.limit_log_axis(axes, np.concatenate(measured), _DECADES)
    elif panel == "state":
        _limit_to_run(axes, points["run"], points["reference"])
    else:
        axes.set_ylim(bottom=0.0)
    draw.legend(axes, [drawn[name] for name in names if name in drawn])


def _measured(panel: str) -> list[str]:
    return [one.column for one in CURVES if one.panel == panel and one.source == "run"]


def _draw_curve(axes: Axes, curve: Curve, columns: Columns) -> list[draw.Shown]:
    t_s, values = columns["t"], draw.finite(columns[curve.column])
    if not np.isfinite(values).any():
        return []
    colour = printed(curve.colour)
    if curve.upper:
        upper = draw.finite(columns[curve.upper])
        filled = axes.fill_between(t_s, values, upper, color=colour, alpha=_BAND_OPACITY, lw=0)
        return [(filled, BAND)]
    if curve.mark:
        style = _MARKS.get(curve.mark, _DOT)
        return draw.marks(axes, t_s, values, curve.name, color=colour, **style)
    return draw.line(axes, t_s, values, curve.name, color=colour, linestyle=_DASHES[curve.dash],
                     linewidth=_POINTS_PER_PIXEL * curve.width)  # fmt: skip


def _limit_to_run(axes: Axes, *runs: Columns) -> None:
    """Show the runs whole; the band of the draws only as far as it is near them."""
    known = [draw.finite(columns[name]) for columns in runs for name in ("x", "x_s", "x_c")
             if len(columns.get(name, ()))]  # fmt: skip
    values = np.concatenate([[0.0], *known])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    room = 0.25 * (high - low) or 1.0
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low - room), min(top, high + room))

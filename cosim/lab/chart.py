"""Draws a figure by the chart library ECharts: plain data, drawn by the browser.

Items with the same points in time share a data set.
"""

from typing import Any

import numpy as np

from cosim.output.figure_description import (
    DASHED,
    DOTTED,
    Band,
    FigureDescription,
    Line,
    Marks,
    Panel,
)
from noack.core.linear_systems import Vector

Options = dict[str, Any]
Numbers = list[float | None]
"""Values of a column; None is a gap."""

HEIGHT = 860
"""Height of the figure in pixels."""
_DIGITS = 5
_TICK = (
    "v => v === 0 || (Math.abs(v) >= 1e-3 && Math.abs(v) < 1e5) ? String(+v.toPrecision(9))"
    " : (+v.toPrecision(9)).toExponential()"
)
"""Text at a value axis in JavaScript: short, so that the panels have equal widths."""
_TITLE, _LEGEND, _TIMES, _BOTTOM = 22, 27, 24, 38
_FONT_PX = 13
_PIXELS_PER_POINT = 4 / 3
_DASHES = {DASHED: "dashed", DOTTED: "dotted"}
_CROSS: Options = {
    "symbol": "path://M2 0L5 3L8 0L10 2L7 5L10 8L8 10L5 7L2 10L0 8L3 5L0 2Z",
    "symbolSize": 9,
}
_DOT: Options = {"symbol": "circle", "symbolSize": 8}


def figure_options(figure: FigureDescription, *, dark: bool) -> Options:
    """Return the options of a figure with one panel in each row."""
    ink, lines = ("#d5d9e0", "#3a3f47") if dark else ("#30363d", "#dfe3e8")
    panels, changing = _panels(figure), data_options(figure)
    heads = [_TITLE + _LEGEND * bool(panel.legend) for panel in panels]
    room = HEIGHT - sum(heads) - _TIMES * (len(panels) - 1) - _BOTTOM
    whole_in = sum(row.height_in for row in figure.rows)
    bottom, grids = float(-_TIMES), []
    for head, row in zip(heads, figure.rows, strict=True):
        top, height = bottom + _TIMES + head, room * row.height_in / whole_in
        bottom = top + height
        grids.append({"left": 58, "right": 16, "top": round(top), "height": round(height)})
    with_legend = [grid for grid, panel in zip(grids, panels, strict=True) if panel.legend]
    text = {"color": ink, "fontSize": _FONT_PX}
    axis = {"axisLine": {"lineStyle": {"color": ink}}, "axisLabel": text,
            "splitLine": {"lineStyle": {"color": lines}}}  # fmt: skip
    return {
        "animation": False,
        "textStyle": {**text, "fontFamily": "Roboto, sans-serif"},
        "aria": {"enabled": True, "label": {"description": figure.description}},
        "tooltip": {"trigger": "axis", "axisPointer": {"type": "line"}, "confine": True,
                    "transitionDuration": 0, ":valueFormatter":
                    "v => v == null ? '–' : Number(v).toPrecision(4)"},
        "axisPointer": {"link": [{"xAxisIndex": "all"}]},
        "grid": grids,
        "title": [{"text": panel.title, "left": 3, "top": grid["top"] - head - 3,
                   "textStyle": {**text, "fontWeight": "bold"}}
                  for panel, grid, head in zip(panels, grids, heads, strict=True)],
        "xAxis": [{"type": "value", "gridIndex": i, "min": 0, "max": panel.x.ends[1],
                   "name": panel.x.label, "nameLocation": "middle",
                   "nameGap": 22, "nameTextStyle": text, **axis} for i, panel in enumerate(panels)],
        "yAxis": [{"type": "log" if panel.y.logarithmic else "value", "gridIndex": i,
                   "scale": panel.y.ends[0] is None, "splitNumber": 4, **axis,
                   "axisLabel": {**text, ":formatter": _TICK}} for i, panel in enumerate(panels)],
        "dataZoom": [{"type": "inside", "xAxisIndex": list(range(len(panels))),
                      "zoomOnMouseWheel": "shift", "preventDefaultMouseMove": False}],
        **changing,
        "legend": [{"type": "scroll", "left": 8, "right": 8, "top": grid["top"] - _LEGEND - 3,
                    "textStyle": text, "pageTextStyle": text, "itemGap": 6, "itemWidth": 10,
                    "inactiveColor": "#808080"} | legend
                   for grid, legend in zip(with_legend, changing["legend"], strict=True)],
    }  # fmt: skip


def data_options(figure: FigureDescription) -> Options:
    """Return the data, the series and their names, which change with each redraw."""
    panels, series, sets = _panels(figure), list[Options](), dict[int, dict[str, Numbers]]()
    for number, panel in enumerate(panels):
        for i, item in enumerate(panel.items):
            assert isinstance(item, Line | Band | Marks)
            columns = sets.setdefault(id(item.x), {"t": _rounded(item.x)})
            series += _series(item, f"{number}-{i}", columns, number, [*sets].index(id(item.x)))
    legends = [
        {"data": [_legend_entry(name, panel) for name in panel.legend]}
        for panel in panels
        if panel.legend
    ]
    datasets = [{"source": one} for one in sets.values()]
    return {"dataset": datasets, "series": series, "legend": legends}


def _panels(figure: FigureDescription) -> list[Panel]:
    return [row.panels[0] for row in figure.rows]


def _series(
    item: Line | Band | Marks, name: str, columns: dict[str, Numbers], panel: int, dataset: int
) -> list[Options]:
    """Add an item's values to its data set; return its series.

    A band is the area between a line and what lies on it.
    """
    colour = f"rgb{item.colour}"
    made: Options = {
        "name": item.label, "datasetIndex": dataset, "xAxisIndex": panel, "yAxisIndex": panel,
        "encode": {"x": "t", "y": name}, "itemStyle": {"color": colour},
    }  # fmt: skip
    columns[name] = _rounded(item.low if isinstance(item, Band) else item.y)
    if isinstance(item, Marks):
        return [made | {"type": "scatter", **(_CROSS if item.marker == "x" else _DOT)}]
    made |= {"type": "line", "symbol": "none", "silent": True}
    if isinstance(item, Line):
        style = {"color": colour, "width": round(_PIXELS_PER_POINT * item.width, 1),
                 "type": _DASHES.get(item.dash, "solid"), "opacity": item.opacity}  # fmt: skip
        return [made | {"lineStyle": style}]
    with np.errstate(all="ignore"):
        columns[f"{name}-width"] = _rounded(item.high - item.low)
    made |= {"stack": "band", "stackStrategy": "all", "lineStyle": {"width": 0},
             "tooltip": {"show": False}}  # fmt: skip
    area = {"color": colour, "opacity": item.opacity}
    above = {"areaStyle": area, "encode": {"x": "t", "y": f"{name}-width"}}
    return [made | {"areaStyle": {"opacity": 0}}, made | above]


def _legend_entry(name: str, panel: Panel) -> Options:
    is_band = any(isinstance(item, Band) and item.label == name for item in panel.items)
    faint = {"icon": "roundRect", "itemStyle": {"opacity": 0.4}}
    return {"name": name} | (faint if is_band else {})


def _rounded(values: Vector) -> Numbers:
    """Return values with a few significant digits; what is not finite is a gap."""
    with np.errstate(all="ignore"):
        size = np.floor(np.log10(np.abs(values)))
        scale = 10.0 ** np.clip(_DIGITS - 1 - size, -300, 300)
        rounded = np.where(np.isfinite(scale), np.rint(values * scale) / scale, values)
    finite = np.isfinite(rounded)
    return [float(one) if ok else None for one, ok in zip(rounded, finite.tolist(), strict=True)]

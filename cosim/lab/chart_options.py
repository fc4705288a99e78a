"""The figure of a run as options of the chart library ECharts: plain data, drawn by the browser.

All series always exist, so that a redraw replaces their data.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.interactive.figure_curves import (
    BAND,
    CROSS,
    CURVES,
    DOT,
    LOGARITHMIC,
    PANELS,
    Columns,
    Curve,
    Shown,
    legends,
    sources,
    titles,
)
from noack.core.linear_systems import Vector

Options = dict[str, Any]

_DIGITS = 5
_TICK = (
    "v => v === 0 || (Math.abs(v) >= 1e-3 && Math.abs(v) < 1e5) ? String(+v.toPrecision(9))"
    " : (+v.toPrecision(9)).toExponential()"
)
"""Text at a value axis in JavaScript: short, so that the panels have equal widths."""
_TITLE, _LEGEND, _TIMES, _BOTTOM = 22, 27, 24, 38
_FONT_PX = 13
HEIGHT = 860
"""Height of the figure in pixels."""
_MARKS: Mapping[str, Options] = {
    DOT: {"symbol": "circle", "symbolSize": 8},
    CROSS: {"symbol": "path://M2 0L5 3L8 0L10 2L7 5L10 8L8 10L5 7L2 10L0 8L3 5L0 2Z",
            "symbolSize": 9},
}  # fmt: skip


def figure_options(shown: Shown) -> Options:
    """Return the options of the whole figure."""
    ink, lines = ("#d5d9e0", "#3a3f47") if shown.dark else ("#30363d", "#dfe3e8")
    changing, named = data_options(shown), legends(sources(shown))
    heads = [_TITLE + _LEGEND * (name in named) for name in PANELS]
    room = HEIGHT - sum(heads) - _TIMES * (len(PANELS) - 1) - _BOTTOM
    bottom, grids = float(-_TIMES), []
    for head, share in zip(heads, PANELS.values(), strict=True):
        top = bottom + _TIMES + head
        bottom = top + room * share
        grids.append({"left": 58, "right": 16, "top": round(top), "height": round(room * share)})
    with_legend = [grid for name, grid in zip(PANELS, grids, strict=True) if name in named]
    text = {"color": ink, "fontSize": _FONT_PX}
    axis = {"axisLine": {"lineStyle": {"color": ink}}, "axisLabel": text,
            "splitLine": {"lineStyle": {"color": lines}}}  # fmt: skip
    heading = titles(shown)
    return {
        "animation": False,
        "textStyle": {**text, "fontFamily": "Roboto, sans-serif"},
        "aria": {"enabled": True, "label": {"description": "; ".join(heading)}},
        "tooltip": {"trigger": "axis", "axisPointer": {"type": "line"}, "confine": True,
                    "transitionDuration": 0, ":valueFormatter":
                    "v => v == null ? '–' : Number(v).toPrecision(4)"},
        "axisPointer": {"link": [{"xAxisIndex": "all"}]},
        "grid": grids,
        "title": [{"text": title, "left": 3, "top": grid["top"] - head - 3,
                   "textStyle": {**text, "fontWeight": "bold"}}
                  for title, grid, head in zip(heading, grids, heads, strict=True)],
        "xAxis": [{"type": "value", "gridIndex": i, "min": 0,
                   "max": float(shown.run.scenario.horizon_s),
                   "name": "time [s]" if i == len(PANELS) - 1 else "", "nameLocation": "middle",
                   "nameGap": 22, "nameTextStyle": text, **axis} for i in range(len(PANELS))],
        "yAxis": [{"type": "log" if name in LOGARITHMIC else "value", "gridIndex": i,
                   "scale": name == "state", "splitNumber": 4, **axis,
                   "axisLabel": {**text, ":formatter": _TICK}}
                  for i, name in enumerate(PANELS)],
        "dataZoom": [{"type": "inside", "xAxisIndex": list(range(len(PANELS))),
                      "zoomOnMouseWheel": "shift", "preventDefaultMouseMove": False}],
        **changing,
        "legend": [{"type": "scroll", "left": 8, "right": 8, "top": grid["top"] - _LEGEND - 3,
                    "textStyle": text, "pageTextStyle": text, "itemGap": 6, "itemWidth": 10,
                    "inactiveColor": "#808080"} | legend
                   for grid, legend in zip(with_legend, changing["legend"], strict=True)],
    }  # fmt: skip


def data_options(shown: Shown) -> Options:
    """Return the data, the series and their names, which change with each redraw."""
    points = sources(shown)
    places = {name: i for i, name in enumerate(points)}
    series = [one for curve in CURVES for one in _series(curve, places[curve.source])]
    return {"dataset": [{"source": _source(one)} for one in points.values()], "series": series,
            "legend": [{"data": [_item(one) for one in names]}
                       for names in legends(points).values()]}  # fmt: skip


def _series(curve: Curve, dataset: int) -> list[Options]:
    """Return the series of a curve; a band is the area between a line and what lies on it."""
    colour = f"rgb{curve.colour}"
    panel = list(PANELS).index(curve.panel)
    made: Options = {
        "name": curve.name, "datasetIndex": dataset, "xAxisIndex": panel, "yAxisIndex": panel,
        "encode": {"x": "t", "y": curve.column}, "itemStyle": {"color": colour},
    }  # fmt: skip
    if curve.mark:
        return [made | {"type": "scatter", **_MARKS[curve.mark]}]
    made |= {"type": "line", "symbol": "none", "silent": True}
    if not curve.upper:
        style = {"color": colour, "width": curve.width, "type": curve.dash}
        return [made | {"lineStyle": style}]
    made |= {"stack": "band", "stackStrategy": "all", "lineStyle": {"width": 0},
             "tooltip": {"show": False}}  # fmt: skip
    return [
        made | {"areaStyle": {"opacity": 0}},
        made | {"areaStyle": {"color": colour, "opacity": 0.22}, "encode": {"x": "t", "y": _WIDTH}},
    ]


_WIDTH = "width"


def _item(name: str) -> Options:
    """Return an entry of a legend."""
    faint = {"icon": "roundRect", "itemStyle": {"opacity": 0.4}}
    return {"name": name} | (faint if name == BAND else {})


def _source(columns: Columns) -> dict[str, list[float | None]]:
    """Return columns with a few significant digits; what is not finite is a gap."""
    found = dict(columns)
    with np.errstate(all="ignore"):
        for one in CURVES:
            if one.upper in found:
                found[_WIDTH] = found[one.upper] - found[one.column]
    return {name: _rounded(values) for name, values in found.items()}


def _rounded(values: Vector) -> list[float | None]:
    with np.errstate(all="ignore"):
        size = np.floor(np.log10(np.abs(values)))
        scale = 10.0 ** np.clip(_DIGITS - 1 - size, -300, 300)
        rounded = np.where(np.isfinite(scale), np.rint(values * scale) / scale, values)
    finite = np.isfinite(rounded)
    return [float(one) if ok else None for one, ok in zip(rounded, finite.tolist(), strict=True)]

"""The table of curves as options of ECharts: a panel below another, with a common time axis."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import noack
from noack_lab.results import NORM, ShownRun, panel_title

Json = dict[str, Any]

REFERENCE = "for comparison"
_GREY = (60, 60, 60)
_CROSS = "path://M0 1L1 0L5 4L9 0L10 1L6 5L10 9L9 10L5 6L1 10L0 9L4 5Z"
_PIXELS_PER_POINT = 4 / 3
_DECADES = 7
"""Below the largest value on a logarithmic axis: an error is 0 after a reset."""
_TITLE, _LINE, _PLOT, _GAP, _FOOT = 24, 25, 120, 30, 46
"""Heights in pixels: the title of a panel, a line of its legend, its axes, the times below them, the
last axis with its name."""
_LEFT, _RIGHT = 62, 14
_CHARACTER, _KEY = 6.2, 42
"""Widths in pixels: a character of a legend, the sample and the gap of an entry."""
_GAP_OF_ENTRIES = 10
PHONE_PX = 366
"""Width of a chart on a phone: of one whose width is not known yet."""


class Drawn(NamedTuple):
    """What a chart shows."""

    run: ShownRun
    state: str
    """Name of the state that is drawn; empty: the first."""
    bounds: Sequence[noack.Curve] = ()
    reference: ShownRun | None = None
    width_px: int = PHONE_PX


def height_px(options: Json) -> int:
    """Return the height of a chart."""
    return int(options["grid"][-1]["top"]) + _PLOT + _FOOT if options["grid"] else _FOOT


def _legend_lines(names: Sequence[str], room: float) -> int:
    """Return how many lines a legend has, which wraps at a width in pixels."""
    lines, used = 1, 0.0
    for name in names:
        width = _KEY + _CHARACTER * len(name)
        if used and used + width > room:
            lines, used = lines + 1, 0.0
        used += width
    return lines


def chart_options(drawn: Drawn) -> Json:
    """Return the options of ECharts."""
    panels = _panels(drawn)
    ends_s = (float(c.t_s[-1]) for curves in panels.values() for c in curves if len(c.t_s))
    end_s = drawn.run.end_s or max(ends_s, default=1.0)
    room = drawn.width_px - _LEFT - _RIGHT
    options: Json = {
        "animation": False,
        "aria": {"enabled": True, "label": {"description": "; ".join(panels)}},
        "textStyle": {"fontFamily": "Roboto, sans-serif"},
        "tooltip": {
            "trigger": "axis",
            "confine": True,
            ":valueFormatter": "value => value == null ? '–' : String(+(+value).toPrecision(4))",
        },
        "toolbox": {
            "right": 8,
            "top": 0,
            "padding": 0,
            "itemSize": 13,
            "feature": {"dataZoom": {"yAxisIndex": "none"}, "saveAsImage": {}},
        },
        "title": [], "legend": [], "grid": [], "xAxis": [], "yAxis": [], "series": [],
    }  # fmt: skip
    top = 0
    for number, (panel, curves) in enumerate(panels.items()):
        title = panel_title(panel, drawn.run.curves)
        is_last = number == len(panels) - 1
        unit = next((f" [{curve.unit}]" for curve in curves if curve.unit), "")
        scale = " (logarithmic)" if curves[0].is_logarithmic else ""
        style = {"fontSize": 14, "fontWeight": 600}
        options["title"].append(
            {"text": f"{title}{unit}{scale}", "top": top + 2, "left": 4, "textStyle": style}
        )
        names = list(dict.fromkeys(curve.name for curve in curves))
        legend: Json = {"data": names, "top": top + _TITLE, "left": _LEFT - 6, "right": _RIGHT}
        options["legend"].append(legend | {"itemGap": _GAP_OF_ENTRIES, "textStyle": {"fontSize": 13}})
        top += _TITLE + _LINE * _legend_lines(names, room) + 2
        options["grid"].append({"top": top, "height": _PLOT, "left": _LEFT, "right": _RIGHT})
        top += _PLOT + _GAP
        axis: Json = {"type": "value", "gridIndex": number, "min": 0, "max": float(f"{end_s:.6g}")}
        axis |= {"axisLabel": {"fontSize": 13}, "splitLine": {"show": False}}
        axis["axisLine"] = {"onZero": False}
        if is_last:
            axis |= {"name": "time t [s]", "nameLocation": "middle", "nameGap": 24}
        options["xAxis"].append(axis | {"nameTextStyle": {"fontSize": 13}})
        options["yAxis"].append(_value_axis(number, curves))
        options["series"] += [_series(curve, number) for curve in curves]
    return options


def layout_of(options: Json) -> object:
    """Return which parts a chart has: panels and their places, kinds of axes, curves."""
    return (
        [grid["top"] for grid in options["grid"]],
        [title["text"] for title in options["title"]],
        [axis["type"] for axis in options["yAxis"]],
        [(series["name"], series["yAxisIndex"]) for series in options["series"]],
    )


def values_of(options: Json) -> Json:
    """Return the curves and the ends of the axes, for a chart that has the same parts."""
    return {
        "xAxis": [{"max": axis["max"]} for axis in options["xAxis"]],
        "yAxis": [{"min": axis.get("min"), "max": axis.get("max")} for axis in options["yAxis"]],
        "series": [{"data": series["data"]} for series in options["series"]],
    }


def _panels(drawn: Drawn) -> dict[str, list[noack.Curve]]:
    """Return the curves of each panel, in the order of the panels; of the states, one is drawn."""
    run, states = drawn.run, drawn.run.states
    state = drawn.state if drawn.state in states else next(iter(states), "")
    panels: dict[str, list[noack.Curve]] = {}
    if drawn.reference is not None:
        for curve in drawn.reference.curves:
            is_norm = curve.panel == NORM and curve.name.endswith(" plant")
            if is_norm or curve.name in ("x plant", "‖e_c‖ controller"):
                style = noack.CurveStyle(_GREY, 1.2, (4, 3))
                faint = noack.Curve(curve.panel, REFERENCE, curve.unit, curve.t_s, curve.values, style)
                panels.setdefault(curve.panel, []).append(faint)
    shown: dict[str, list[noack.Curve]] = {}
    for curve in (*run.curves, *drawn.bounds):
        if len(curve.t_s) and np.isfinite(curve.values).any():
            shown.setdefault(curve.panel, []).append(curve)
    return {
        panel: [*panels.get(panel, ()), *curves]
        for panel, curves in shown.items()
        if panel == state or panel not in states
    }


def _value_axis(number: int, curves: Sequence[noack.Curve]) -> Json:
    """Return the vertical axis: logarithmic within some decades of the run's own largest value."""
    axis: Json = {"gridIndex": number, "axisLabel": {"fontSize": 13}, "splitNumber": 4}
    if not curves[0].is_logarithmic:
        return axis | {"type": "value", "scale": True}
    measured = [curve.values for curve in curves if not curve.style.dash]
    values = np.concatenate([np.zeros(0), *(curve.values for curve in curves)])
    values = values[np.isfinite(values) & (values > 0)]
    own = np.concatenate([np.zeros(0), *measured])
    own = own[np.isfinite(own) & (own > 0)]
    if not len(own) or not len(values):
        return axis | {"type": "value", "scale": True}
    top = math.ceil(math.log10(min(values.max(), own.max() * 10.0**_DECADES)))
    bottom = math.floor(math.log10(max(values.min(), own.max() / 10.0**_DECADES)))
    ends = {"min": 10.0**bottom, "max": 10.0 ** max(top, bottom + 1)}
    number_text = "value => Math.abs(Math.log10(value)) < 3.5 ? String(value) : value.toExponential(0)"
    axis["axisLabel"] |= {":formatter": number_text}
    return axis | {"type": "log", **ends, "minorSplitLine": {"show": False}}


def _series(curve: noack.Curve, number: int) -> Json:
    """Return a curve; what is not finite, or not positive on a logarithmic axis, is a gap."""
    known, style = np.isfinite(curve.values), curve.style
    if curve.is_logarithmic:
        known &= curve.values > 0
    colour = "rgb({}, {}, {})".format(*style.colour)
    times, values = _rounded(curve.t_s), _rounded(np.where(known, curve.values, 0.0))
    points = [[t, v if ok else None] for t, v, ok in zip(times, values, known.tolist(), strict=True)]
    series: Json = {"name": curve.name, "xAxisIndex": number, "yAxisIndex": number, "data": points}
    series |= {"itemStyle": {"color": colour}}
    if style.marker:
        symbol = "circle" if style.marker == "o" else _CROSS
        return series | {"type": "scatter", "symbol": symbol, "symbolSize": 8}
    line: Json = {"color": colour, "width": round(_PIXELS_PER_POINT * style.width, 1)}
    if style.dash:
        line["type"] = [round(length * style.width, 1) for length in style.dash]
    series |= {"type": "line", "showSymbol": False, "lineStyle": line, "emphasis": {"disabled": True}}
    return series | ({"step": "end"} if style.is_held else {})


def _rounded(values: Any) -> list[float]:
    """Return values with six significant digits, so that less is sent."""
    return [float(f"{value:.6g}") for value in values.tolist()]

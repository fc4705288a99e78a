"""The figure of a run as options of the chart library ECharts: plain data, drawn by the browser.

Four panels share the time axis: a state with its two models, the errors, ‖x‖, and the transmissions
with the time since the last one. All series always exist, so that a redraw replaces their data.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.interactive.ensemble import Ensemble
from cosim.interactive.exploration import Exploration
from cosim.interactive.scenario_guarantee import Guarantee
from cosim.output import palette
from noack.core.linear_systems import Vector

Options = dict[str, Any]

_DIGITS = 5
_SMALLEST = 1e-6
"""Smallest value on a logarithmic axis, as a share of the largest; an error is 0 after a reset."""
_PANELS = ("state", "errors", "norm", "events")
_SHARES = (0.28, 0.28, 0.2, 0.24)
"""Of the height that titles, legends and times leave."""
_TICK = (
    "v => v === 0 || (Math.abs(v) >= 1e-3 && Math.abs(v) < 1e5) ? String(+v.toPrecision(9))"
    " : (+v.toPrecision(9)).toExponential()"
)
"""Text at a value axis in JavaScript: short, so that the panels have equal widths."""
_TITLE, _LEGEND, _TIMES, _BOTTOM = 22, 24, 24, 38
HEIGHT = 860
"""Height of the figure in pixels."""


class Shown(NamedTuple):
    """What the figure shows."""

    run: Exploration
    state: int
    """Number of the drawn state, from 0 on."""
    ensemble: Ensemble | None = None
    guarantee: Guarantee | None = None
    reference: Exploration | None = None
    """A run with other settings, for comparison."""
    dark: bool = False


def figure_options(shown: Shown) -> Options:
    """Return the options of the whole figure."""
    ink, lines = ("#d5d9e0", "#3a3f47") if shown.dark else ("#30363d", "#dfe3e8")
    legends = _legends(shown)
    heads = [_TITLE + _LEGEND * (name in legends) for name in _PANELS]
    room = HEIGHT - sum(heads) - _TIMES * (len(_PANELS) - 1) - _BOTTOM
    bottom, grids = float(-_TIMES), []
    for head, share in zip(heads, _SHARES, strict=True):
        top = bottom + _TIMES + head
        bottom = top + room * share
        grids.append({"left": 54, "right": 16, "top": round(top), "height": round(room * share)})
    text = {"color": ink}
    axis = {"axisLine": {"lineStyle": {"color": ink}}, "axisLabel": text,
            "splitLine": {"lineStyle": {"color": lines}}}  # fmt: skip
    titles = _titles(shown)
    return {
        "animation": False,
        "textStyle": {"color": ink, "fontFamily": "inherit"},
        "aria": {"enabled": True, "label": {"description": "; ".join(titles)}},
        "legend": [{"type": "scroll", "left": 8, "right": 8, "top": grid["top"] - _LEGEND - 3,
                    "textStyle": text, "pageTextStyle": text, "itemGap": 8, "itemWidth": 12,
                    "inactiveColor": "#808080", "data": legends[name]}
                   for name, grid in zip(_PANELS, grids, strict=True) if name in legends],
        "tooltip": {"trigger": "axis", "axisPointer": {"type": "line"}, "confine": True,
                    "transitionDuration": 0, ":valueFormatter":
                    "v => v == null ? '–' : Number(v).toPrecision(4)"},
        "axisPointer": {"link": [{"xAxisIndex": "all"}]},
        "grid": grids,
        "title": [{"text": title, "left": 3, "top": grid["top"] - head - 3,
                   "textStyle": {"fontSize": 13, "fontWeight": "bold", "color": ink}}
                  for title, grid, head in zip(titles, grids, heads, strict=True)],
        "xAxis": [{"type": "value", "gridIndex": i, "min": 0,
                   "max": float(shown.run.scenario.horizon_s),
                   "name": "time [s]" if i == len(_PANELS) - 1 else "", "nameLocation": "middle",
                   "nameGap": 22, "nameTextStyle": text, **axis} for i in range(len(_PANELS))],
        "yAxis": [{"type": "log" if name in ("errors", "norm") else "value", "gridIndex": i,
                   "scale": name == "state", "splitNumber": 4, **axis,
                   "axisLabel": {**text, ":formatter": _TICK}}
                  for i, name in enumerate(_PANELS)],
        "dataZoom": [{"type": "inside", "xAxisIndex": list(range(len(_PANELS))),
                      "zoomOnMouseWheel": "shift", "preventDefaultMouseMove": False}],
        **data_options(shown),
    }  # fmt: skip


def data_options(shown: Shown) -> Options:
    """Return the data and the series, which change with each redraw."""
    sources = {
        "run": _run_source(shown),
        "reference": _reference_source(shown),
        "ensemble": _ensemble_source(shown),
        "guarantee": _guarantee_source(shown),
        "delivered": _event_source(shown.run, delivered=True),
        "lost": _event_source(shown.run, delivered=False),
    }
    return {
        "dataset": [{"source": source} for source in sources.values()],
        "series": [_series(one, list(sources).index(one.source)) for one in _curves()],
    }


class _Curve(NamedTuple):
    name: str
    panel: str
    source: str
    column: str
    colour: palette.Colour
    style: Mapping[str, Any]


_LINE: Mapping[str, Any] = {"width": 1.8}
_THIN: Mapping[str, Any] = {"width": 1.2, "type": "dashed"}
_EDGE: Mapping[str, Any] = {"width": 1, "type": "dotted"}
_BAND, _KEPT = "90 % of draws", "kept settings"


def _curves() -> list[_Curve]:
    return [
        _Curve(_BAND, "state", "ensemble", "low", palette.PLANT, {"stack": "band"}),
        _Curve(_BAND, "state", "ensemble", "width", palette.PLANT, {"stack": "band", "area": True}),
        _Curve("plant x", "state", "run", "x", palette.PLANT, {"width": 3}),
        _Curve("sensor x_s", "state", "run", "x_s", palette.SENSOR, _LINE),
        _Curve("controller x_c", "state", "run", "x_c", palette.CONTROLLER, _LINE),
        _Curve(_KEPT, "state", "reference", "x", palette.FORCED, _THIN),
        _Curve("threshold", "errors", "run", "threshold", palette.THRESHOLD, _THIN),
        _Curve("‖e_s‖", "errors", "run", "e_s", palette.SENSOR, _LINE),
        _Curve("‖e_c‖", "errors", "run", "e_c", palette.CONTROLLER, _LINE),
        _Curve("certified bound", "errors", "guarantee", "e_c", palette.CERTIFIED, _LINE),
        _Curve(_BAND, "errors", "ensemble", "e_c_high", palette.PLANT, _EDGE),
        _Curve(_KEPT, "errors", "reference", "e_c", palette.FORCED, _THIN),
        _Curve("‖x‖", "norm", "run", "norm", palette.PLANT, {"width": 3}),
        _Curve("certified bound", "norm", "guarantee", "x", palette.CERTIFIED, _LINE),
        _Curve(_BAND, "norm", "ensemble", "norm_low", palette.PLANT, _EDGE),
        _Curve(_BAND, "norm", "ensemble", "norm_high", palette.PLANT, _EDGE),
        _Curve(_KEPT, "norm", "reference", "norm", palette.FORCED, _THIN),
        _Curve("delivered", "events", "delivered", "since", palette.CONTROLLER,
               {"symbol": "circle", "size": 8}),
        _Curve("lost", "events", "lost", "since", palette.LOST,
               {"symbol": "path://M2 0L5 3L8 0L10 2L7 5L10 8L8 10L5 7L2 10L0 8L3 5L0 2Z",
                "size": 9}),
    ]  # fmt: skip


def _series(curve: _Curve, dataset: int) -> Options:
    colour = f"rgb{curve.colour}"
    panel, style = _PANELS.index(curve.panel), dict(curve.style)
    made: Options = {
        "name": curve.name, "datasetIndex": dataset, "xAxisIndex": panel, "yAxisIndex": panel,
        "encode": {"x": "t", "y": curve.column}, "itemStyle": {"color": colour},
    }  # fmt: skip
    if "symbol" in style:
        return made | {"type": "scatter", "symbol": style["symbol"], "symbolSize": style["size"]}
    made |= {"type": "line", "symbol": "none", "silent": True}
    if "stack" in style:
        area = {"color": colour, "opacity": 0.22} if style.get("area") else {"opacity": 0}
        return made | {"stack": "band", "stackStrategy": "all", "lineStyle": {"width": 0},
                       "areaStyle": area, "tooltip": {"show": False}}  # fmt: skip
    return made | {"lineStyle": {"color": colour, **style}}


def _titles(shown: Shown) -> Sequence[str]:
    name = shown.run.state_names[shown.state]
    return (
        f"{name}: plant and both models", "errors of the models (logarithmic)",
        "‖x‖ (logarithmic)", "transmissions: time since the last one [s]",
    )  # fmt: skip


def _legends(shown: Shown) -> dict[str, list[Options]]:
    """Return the legends of panels; a name that several panels have is in the first one's only."""
    known = {_KEPT, "‖x‖"} if shown.reference is None else {"‖x‖"}
    found: dict[str, list[Options]] = {}
    for curve in _curves():
        if curve.name not in known:
            known.add(curve.name)
            faint = {"icon": "roundRect", "itemStyle": {"opacity": 0.4}}
            item = {"name": curve.name} | (faint if curve.name == _BAND else {})
            found.setdefault(curve.panel, []).append(item)
    return found


def _run_source(shown: Shown) -> Options:
    run, i = shown.run, shown.state
    floor = _floor(run)
    threshold = np.full(len(run.t_s), np.nan) if run.threshold is None else run.threshold
    return _columns(
        t=run.t_s, x=run.x[:, i], x_s=run.x_s[:, i], x_c=run.x_c[:, i], threshold=threshold,
        e_s=_positive(run.e_s_norm, floor), e_c=_positive(run.e_c_norm, floor),
        norm=_positive(run.x_norm, _SMALLEST * _largest(run.x_norm)),
    )  # fmt: skip


def _reference_source(shown: Shown) -> Options:
    run = shown.reference
    if run is None or shown.state >= run.x.shape[1]:
        return _columns(t=[], x=[], e_c=[], norm=[])
    return _columns(
        t=run.t_s, x=run.x[:, shown.state], e_c=_positive(run.e_c_norm, _floor(shown.run)),
        norm=_positive(run.x_norm, _SMALLEST * _largest(run.x_norm)),
    )  # fmt: skip


def _ensemble_source(shown: Shown) -> Options:
    found = shown.ensemble
    if found is None or shown.state >= len(found.states):
        return _columns(t=[], low=[], width=[], e_c_high=[], norm_low=[], norm_high=[])
    band = found.states[shown.state]
    with np.errstate(all="ignore"):
        width = band.high - band.low
    return _columns(
        t=found.t_s, low=band.low, width=width,
        e_c_high=_positive(found.e_c_norm.high, _floor(shown.run)),
        norm_low=_positive(found.x_norm.low, 0.0), norm_high=_positive(found.x_norm.high, 0.0),
    )  # fmt: skip


def _guarantee_source(shown: Shown) -> Options:
    found = shown.guarantee
    if found is None:
        return _columns(t=[], e_c=[], x=[])
    return _columns(t=found.t_s, e_c=found.e_c, x=found.x)


def _event_source(run: Exploration, *, delivered: bool) -> Options:
    since = np.diff(run.event_s, prepend=0.0)
    chosen = run.delivered == delivered
    return _columns(t=run.event_s[chosen], since=since[chosen])


def _floor(run: Exploration) -> float:
    """Return the smallest error that is drawn: errors are 0 after a reset."""
    known = [run.e_s_norm, run.e_c_norm]
    if run.threshold is not None and len(run.threshold):
        return 0.01 * float(np.min(run.threshold))
    return _SMALLEST * max(_largest(one) for one in known)


def _largest(values: Vector) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max(initial=0.0)) or 1.0


def _positive(values: Vector, floor: float) -> Vector:
    """Return values for a logarithmic axis: not below a floor; NaN if that is 0."""
    with np.errstate(all="ignore"):
        return np.where(values > floor, values, floor if floor > 0 else np.nan)


def _columns(**columns: Sequence[float] | Vector) -> dict[str, list[float | None]]:
    """Return columns with a few significant digits; what is not finite is a gap."""
    return {name: _rounded(np.asarray(values, dtype=np.float64))
            for name, values in columns.items()}  # fmt: skip


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    with np.errstate(all="ignore"):
        size = np.floor(np.log10(np.abs(values)))
        scale = 10.0 ** np.clip(_DIGITS - 1 - size, -300, 300)
        rounded = np.where(np.isfinite(scale), np.rint(values * scale) / scale, values)
    finite = np.isfinite(rounded)
    return [float(one) if ok else None for one, ok in zip(rounded, finite.tolist(), strict=True)]

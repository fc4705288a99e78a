"""What the figure of a run shows, as plain data: panels, curves and their points.

The page draws it with ECharts, a notebook with matplotlib. Four panels share the time axis: a state
with its two models, the errors, ‖x‖, and the transmissions with the time since the last one.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cosim.interactive.ensemble import Ensemble
from cosim.interactive.exploration import Exploration
from cosim.interactive.scenario_guarantee import Guarantee
from cosim.output import palette
from noack.core.linear_systems import Vector

_SMALLEST = 1e-6
"""Smallest value on a logarithmic axis, as a share of the largest; an error is 0 after a reset."""
PANELS: Mapping[str, float] = {"state": 0.28, "errors": 0.28, "norm": 0.2, "events": 0.24}
"""Shares of the height that titles, legends and times leave."""
LOGARITHMIC = ("errors", "norm")
"""Panels whose vertical axis is logarithmic."""
BAND, KEPT = "90 % of draws", "kept settings"
CROSS, DOT = "cross", "dot"
_NO_POINTS = np.empty(0)


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


class Curve(NamedTuple):
    """A line, the filled band between two columns, or marks."""

    name: str
    panel: str
    source: str
    column: str
    colour: palette.Colour
    width: float = 1.8
    dash: str = "solid"
    """solid, dashed or dotted."""
    upper: str = ""
    """Of a band: the column of its upper edge."""
    mark: str = ""
    """CROSS, DOT, or empty for lines."""


CURVES = (
    Curve(BAND, "state", "ensemble", "low", palette.PLANT, upper="high"),
    Curve("plant x", "state", "run", "x", palette.PLANT, 3),
    Curve("sensor x_s", "state", "run", "x_s", palette.SENSOR),
    Curve("controller x_c", "state", "run", "x_c", palette.CONTROLLER),
    Curve(KEPT, "state", "reference", "x", palette.FORCED, 1.2, "dashed"),
    Curve("threshold", "errors", "run", "threshold", palette.THRESHOLD, 1.2, "dashed"),
    Curve("‖e_s‖", "errors", "run", "e_s", palette.SENSOR),
    Curve("‖e_c‖", "errors", "run", "e_c", palette.CONTROLLER),
    Curve("certified bound", "errors", "guarantee", "e_c", palette.CERTIFIED),
    Curve(BAND, "errors", "ensemble", "e_c_high", palette.PLANT, 1, "dotted"),
    Curve(KEPT, "errors", "reference", "e_c", palette.FORCED, 1.2, "dashed"),
    Curve("‖x‖", "norm", "run", "norm", palette.PLANT, 3),
    Curve("certified bound", "norm", "guarantee", "x", palette.CERTIFIED),
    Curve(BAND, "norm", "ensemble", "norm_low", palette.PLANT, 1, "dotted"),
    Curve(BAND, "norm", "ensemble", "norm_high", palette.PLANT, 1, "dotted"),
    Curve(KEPT, "norm", "reference", "norm", palette.FORCED, 1.2, "dashed"),
    Curve("delivered", "events", "delivered", "since", palette.CONTROLLER, mark=DOT),
    Curve("lost", "events", "lost", "since", palette.LOST, mark=CROSS),
)

Columns = Mapping[str, Vector]
"""The points of a source: its times ``t``, and a column of values for each of its curves."""


def sources(shown: Shown) -> dict[str, Columns]:
    """Return the points by source; what is not there has columns without points."""
    found = {
        "run": _run(shown),
        "reference": _reference(shown),
        "ensemble": _ensemble(shown),
        "guarantee": _guarantee(shown),
        "delivered": _events(shown.run, delivered=True),
        "lost": _events(shown.run, delivered=False),
    }
    columns = {name: {"t": _NO_POINTS} for name in found}
    for curve in CURVES:
        columns[curve.source] |= {name: _NO_POINTS for name in (curve.column, curve.upper) if name}
    return {name: {**columns[name], **given} for name, given in found.items()}


def is_drawn(curve: Curve, points: Mapping[str, Columns]) -> bool:
    """Whether a curve has a point."""
    return bool(np.isfinite(points[curve.source][curve.column]).any())


def titles(shown: Shown) -> Sequence[str]:
    """Return the titles of the panels."""
    name = shown.run.state_names[shown.state]
    return (
        f"{name}: plant and both models", "errors of the models (logarithmic)",
        "‖x‖ (logarithmic)", "transmissions: time since the last one [s]",
    )  # fmt: skip


def legends(points: Mapping[str, Columns]) -> dict[str, list[str]]:
    """Return the names in the legends of panels: of what is drawn, each in one panel only.

    A panel whose curves have names of its own is always there, perhaps without names.
    """
    known, found = {"‖x‖"}, dict[str, list[str]]()
    for curve in CURVES:
        if curve.name not in known:
            known.add(curve.name)
            names = found.setdefault(curve.panel, [])
            names += [curve.name] * any(is_drawn(one, points) for one in CURVES
                                        if one.name == curve.name)  # fmt: skip
    return found


def _run(shown: Shown) -> Columns:
    run, i = shown.run, shown.state
    floor, known = _floor(run), run.controller_knows
    threshold = np.full(len(run.t_s), np.nan) if run.threshold is None else run.threshold
    return {
        "t": run.t_s, "x": run.x[:, i], "x_s": run.x_s[:, i],
        "x_c": np.where(known, run.x_c[:, i], np.nan),
        "threshold": threshold, "e_s": _positive(run.e_s_norm, floor),
        "e_c": np.where(known, _positive(run.e_c_norm, floor), np.nan), "norm": _norm(run),
    }  # fmt: skip


def _reference(shown: Shown) -> Columns:
    run = shown.reference
    if run is None or shown.state >= run.x.shape[1]:
        return {}
    e_c = np.where(run.controller_knows, _positive(run.e_c_norm, _floor(shown.run)), np.nan)
    return {"t": run.t_s, "x": run.x[:, shown.state], "e_c": e_c, "norm": _norm(run)}


def _ensemble(shown: Shown) -> Columns:
    found = shown.ensemble
    if found is None or shown.state >= len(found.states):
        return {}
    band = found.states[shown.state]
    return {
        "t": found.t_s, "low": band.low, "high": band.high,
        "e_c_high": _positive(found.e_c_norm.high, _floor(shown.run)),
        "norm_low": _positive(found.x_norm.low, 0.0),
        "norm_high": _positive(found.x_norm.high, 0.0),
    }  # fmt: skip


def _guarantee(shown: Shown) -> Columns:
    found = shown.guarantee
    return {} if found is None else {"t": found.t_s, "e_c": found.e_c, "x": found.x}


def _events(run: Exploration, *, delivered: bool) -> Columns:
    chosen = run.delivered == delivered
    return {"t": run.event_s[chosen], "since": np.diff(run.event_s, prepend=0.0)[chosen]}


def _norm(run: Exploration) -> Vector:
    return _positive(run.x_norm, _SMALLEST * _largest(run.x_norm))


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

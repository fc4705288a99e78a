"""The figure of an explored run: a state with its two models, errors, ‖x‖, and transmissions."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cosim.interactive.exploration import Ensemble, Exploration
from cosim.interactive.scenario_guarantee import Guarantee
from cosim.output.curves import DASHED
from cosim.output.figures.figure_description import (
    DOTTED,
    Axis,
    Band,
    FigureDescription,
    Line,
    Marks,
    Panel,
    PanelRow,
    time_axis,
)
from cosim.output.figures.palette import CERTIFIED, CONTROLLER, FORCED, LOST, PLANT, SENSOR, THRESHOLD
from noack.core.linear_systems import Vector

BAND, EDGE, REFERENCE = "90 % of draws", "edge of the 90 % of draws", "for comparison"
_SMALLEST = 1e-6
"""Smallest value on a logarithmic axis, as a share of the largest; an error is 0 after a reset."""
_DECADES = 7
"""Below and above the largest value on a logarithmic axis; a bound may be far above the run."""
_HEIGHTS_IN = (1.96, 1.96, 1.4, 1.68)
"""Heights of the panels, from the top."""


class ExploredRun(NamedTuple):
    """A run, and all that the figure shows with it."""

    run: Exploration
    state: int
    """Number of the drawn state, from 0 on."""
    ensemble: Ensemble | None = None
    guarantee: Guarantee | None = None
    reference: Exploration | None = None
    """A run with other settings, for comparison."""


def exploration_figure(explored: ExploredRun) -> FigureDescription:
    """Describe the four panels of a run with all that is known of it.

    A name that several panels show is in the legend of the first.
    """
    names_in_legends, rows = {"‖x‖"}, list[PanelRow]()
    contents = [_state(explored), _errors(explored), _norm(explored), _events(explored)]
    horizon_s = np.array([0.0, explored.run.scenario.horizon_s])
    for content, height_in in zip(contents, _HEIGHTS_IN, strict=True):
        items = [item for item in content.items if _has_points(item)]
        names = [*dict.fromkeys(item.label for item in items)]
        legend = sorted((name for name in names if name not in names_in_legends), key=REFERENCE.__eq__)
        names_in_legends |= {*names}
        x = time_axis(horizon_s, numbers=len(rows) == len(contents) - 1)
        panel = Panel(title=content.title, items=items, x=x, y=content.y, legend=legend)
        rows.append(PanelRow(panels=[panel], height_in=height_in))
    description = "; ".join(content.title for content in contents)
    return FigureDescription(name="exploration", rows=rows, description=description)


class _PanelContent(NamedTuple):
    title: str
    items: Sequence[Band | Line | Marks]
    y: Axis


def _has_points(item: Band | Line | Marks) -> bool:
    return bool(np.isfinite(item.low if isinstance(item, Band) else item.y).any())


def _state(explored: ExploredRun) -> _PanelContent:
    run, i, draws, reference = explored.run, explored.state, explored.ensemble, explored.reference
    x, x_s = run.x[:, i], run.x_s[:, i]
    x_c = np.where(run.controller_has_state, run.x_c[:, i], np.nan)
    items: list[Band | Line | Marks] = [
        Line(x=run.t_s, y=x, label="plant x", colour=PLANT, width=2.25),
        Line(x=run.t_s, y=x_s, label="sensor x_s", colour=SENSOR),
        Line(x=run.t_s, y=x_c, label="controller x_c", colour=CONTROLLER),
    ]
    about = np.concatenate([x, x_s, x_c])
    if draws is not None and i < len(draws.states):
        low, high = draws.states[i].low, draws.states[i].high
        band = Band(x=draws.t_s, low=low, high=high, label=BAND, colour=PLANT, opacity=0.22)
        items.insert(0, band)
    if reference is not None and i < reference.x.shape[1]:
        items.insert(0, _reference_line(reference, reference.x[:, i]))
        about = np.concatenate([about, reference.x[:, i]])
    return _PanelContent(f"{run.state_names[i]}: plant and both models", items, Axis(about=about))


def _errors(explored: ExploredRun) -> _PanelContent:
    run, draws, reference = explored.run, explored.ensemble, explored.reference
    floor, guarantee = _floor(run), explored.guarantee
    e_s, e_c = _positive(run.e_s_norm, floor), _known_error(run, floor)
    items = [
        Line(x=run.t_s, y=e_s, label="‖e_s‖", colour=SENSOR),
        Line(x=run.t_s, y=e_c, label="‖e_c‖", colour=CONTROLLER),
    ]
    about = np.concatenate([e_s, e_c])
    if (level := run.threshold) is not None:
        threshold = Line(x=run.t_s, y=level, label="threshold", colour=THRESHOLD, width=0.9)
        items.insert(0, replace(threshold, dash=DASHED))
        about = np.concatenate([about, level])
    if guarantee is not None:
        items.append(_certified_line(guarantee, guarantee.e_c))
    if draws is not None:
        items.append(_edge(draws, _positive(draws.e_c_norm.high, floor)))
    if reference is not None:
        items.insert(0, _reference_line(reference, _known_error(reference, floor)))
    y = Axis(logarithmic=True, about=about, decades=_DECADES)
    return _PanelContent("errors of the models (logarithmic)", items, y)


def _norm(explored: ExploredRun) -> _PanelContent:
    run, draws, reference, guarantee = explored.run, explored.ensemble, explored.reference, explored.guarantee
    norm = _positive(run.x_norm, _SMALLEST * _largest(run.x_norm))
    items = [Line(x=run.t_s, y=norm, label="‖x‖", colour=PLANT, width=2.25)]
    if guarantee is not None:
        items.append(_certified_line(guarantee, guarantee.x))
    if draws is not None:
        edges = (draws.x_norm.low, draws.x_norm.high)
        items += [_edge(draws, _positive(edge, 0.0)) for edge in edges]
    if reference is not None:
        items.insert(
            0, _reference_line(reference, _positive(reference.x_norm, _SMALLEST * _largest(reference.x_norm)))
        )
    y = Axis(logarithmic=True, about=norm, decades=_DECADES)
    return _PanelContent("‖x‖ (logarithmic)", items, y)


def _events(explored: ExploredRun) -> _PanelContent:
    t_s, delivered = explored.run.event_s, explored.run.delivered
    since_s = np.diff(t_s, prepend=0.0)
    dots = Marks(x=t_s[delivered], y=since_s[delivered], label="delivered", colour=CONTROLLER)
    crosses = Marks(x=t_s[~delivered], y=since_s[~delivered], label="lost", colour=LOST)
    items = [dots, replace(crosses, marker="x", stroke=1.6)]
    if (reference := explored.reference) is not None:
        between_s = np.diff(reference.event_s, prepend=0.0)
        marks = Marks(x=reference.event_s, y=between_s, label=REFERENCE, colour=FORCED, opacity=0.45)
        items.insert(0, marks)
    return _PanelContent("transmissions: time since the last one [s]", items, Axis(ends=(0.0, None)))


def _certified_line(guarantee: Guarantee, values: Vector) -> Line:
    return Line(x=guarantee.t_s, y=values, label="certified bound", colour=CERTIFIED)


def _edge(ensemble: Ensemble, values: Vector) -> Line:
    return Line(x=ensemble.t_s, y=values, label=EDGE, colour=PLANT, width=0.75, dash=DOTTED)


def _reference_line(reference: Exploration, values: Vector) -> Line:
    return Line(x=reference.t_s, y=values, label=REFERENCE, colour=FORCED, width=0.9, dash=DASHED)


def _known_error(run: Exploration, floor: float) -> Vector:
    """Return ‖e_c‖ for a logarithmic axis, NaN before the controller's first update."""
    return np.where(run.controller_has_state, _positive(run.e_c_norm, floor), np.nan)


def _floor(run: Exploration) -> float:
    """Return the smallest error that is drawn: errors are 0 after a reset."""
    if run.threshold is not None and len(run.threshold):
        return 0.01 * float(np.min(run.threshold))
    return _SMALLEST * max(_largest(norm) for norm in (run.e_s_norm, run.e_c_norm))


def _largest(values: Vector) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max(initial=0.0)) or 1.0


def _positive(values: Vector, floor: float) -> Vector:
    """Return values for a logarithmic axis: not below a floor; NaN if that is 0."""
    with np.errstate(all="ignore"):
        return np.where(values > floor, values, floor if floor > 0 else np.nan)

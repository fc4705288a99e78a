"""The curves of a run as one small table: name, unit, times, values, style.

The figures of a run's signals (:mod:`cosim.output.figures.run_figures`) and programs that draw by
other means read it (:meth:`noack.Run.curves`). The functions make the rows of a subject from arrays:
k times, n states, m inputs. Norms are those of the run's trigger, ‖v‖ = ‖W v‖₂.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.output.figures import palette
from cosim.output.figures.palette import CONTROLLER, LOST, PLANT, SENSOR, THRESHOLD, Colour
from noack.core.linear_systems import Matrix, Vector
from noack.scenario.outputs import DISTANCE, LoopOutput

Dash = tuple[float, ...]
"""Lengths of strokes and gaps, in widths of the line; empty: a solid line."""
SOLID: Dash = ()
DASHED: Dash = (6, 2.5)
DASHES: tuple[Dash, ...] = (SOLID, (6, 1.5), (2, 1.2), (6, 1.5, 1.5, 1.5))
"""Dashes that distinguish series in addition to their colours."""

ERRORS, STATE_NORM, INPUT, INTERVALS = "error norms", "norm of the state", "input", "inter-event time"
"""Panels; that of a state has the state's name, or ``state NAME`` if another panel may be called so."""

_STATE = "state "
BoundKind = Literal["certified", "identity", "printed"]
"""Source of a bound: a certificate, identity (I1), or ("printed") a formula of the paper."""
_BOUND_STYLES: dict[BoundKind, tuple[Colour, tuple[Dash, ...]]] = {
    # There may be several certificates, for different conditions.
    "certified": (palette.CERTIFIED, (DASHED, (3, 1.5), (6, 2, 1.5, 2), (10, 3))),
    "identity": (palette.IDENTITY, ((1.2, 1.4),)),
    "printed": (palette.PRINTED, ((6, 1.5, 1, 1.5, 1, 1.5),)),
}
Quantity = str
"""What is bounded: "e_c", "x", "inter_event", or an output, as its panel is called."""
_PANELS: dict[Quantity, str] = {"e_c": ERRORS, "x": STATE_NORM, "inter_event": INTERVALS}


class CurveStyle(NamedTuple):
    """How a curve is drawn.

    >>> import noack
    >>> noack.CurveStyle((27, 31, 36), width=2.0).marker
    ''
    """

    colour: Colour
    """Red, green and blue, 0 to 255."""
    width: float = 1.3
    """In points."""
    dash: Dash = SOLID
    """Lengths of strokes and gaps, in widths of the line; empty: a solid line."""
    marker: Literal["", "o", "x"] = ""
    """Points instead of a line: dots or crosses."""
    is_held: bool = False
    """Whether each value holds until the next time: a staircase."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity of a run over time, t in seconds; :meth:`noack.Run.curves` returns a list of them.

    >>> import noack
    >>> curves = noack.simulate_exactly("lane_following").curves()
    >>> [curve.name for curve in curves if curve.panel == "error norms"]
    ['‖e_c‖ controller', '‖e_s‖ sensor', 'threshold']
    >>> curves[0].t_s.shape == curves[0].values.shape
    True
    """

    panel: str
    """What is shown; curves with the same panel share their axes."""
    name: str
    unit: str
    """Empty: that of the model."""
    t_s: Vector
    """(k,) in ascending order."""
    values: Vector
    """(k,); NaN where there is none."""
    style: CurveStyle

    @property
    def is_logarithmic(self) -> bool:
        """Whether the curve needs a logarithmic axis: norms, which fall over decades."""
        return self.panel in (ERRORS, STATE_NORM) or self.panel.startswith(DISTANCE)


def state_curves(
    names: Sequence[str],
    t_s: Vector,
    x: Matrix,
    x_s: Matrix,
    x_c: Matrix,
    x_hat: Matrix | None = None,
    x_r: Matrix | None = None,
    units: Sequence[str] | None = None,
) -> list[Curve]:
    """Return the curves of n states, (k, n): plant, both models, the sensor's estimate, the reference.

    ``units`` are those of the states, if they are known.

    The widths differ, so that equal curves stay visible one inside the other.
    """
    sources = [
        ("x plant", x, CurveStyle(PLANT, 5.4)),
        ("x̂ sensor", x_hat, CurveStyle(SENSOR, 1.0, (1, 1))),
        ("x_s sensor", x_s, CurveStyle(SENSOR, 1.2)),
        ("x_c controller", x_c, CurveStyle(CONTROLLER, 3.2)),
        ("x_r reference", x_r, CurveStyle(THRESHOLD, 1.2, (4, 2))),
    ]
    return [
        Curve(_panel_of_state(state), name, units[i] if units else "", t_s, states[:, i], style)
        for i, state in enumerate(names)
        for name, states, style in sources
        if states is not None
    ]


def _panel_of_state(name: str) -> str:
    """Return the name of a state, or another one if a panel of something else may have this name."""
    is_of_others = name in (ERRORS, STATE_NORM, INPUT, INTERVALS) or name.startswith((DISTANCE, _STATE))
    return f"{_STATE}{name}" if is_of_others else name


def output_curves(output: LoopOutput, t_s: Vector, distance: Vector) -> list[Curve]:
    """Return an output's distance from what it follows, (k,), and its allowed error."""
    panel = output.distance
    curves = [Curve(panel, output.name, output.unit, t_s, distance, CurveStyle(PLANT, 2.4))]
    if output.allowed is not None and len(t_s):
        ends_s, allowed = t_s[[0, -1]], np.full(2, output.allowed)
        curves.append(Curve(panel, "allowed", output.unit, ends_s, allowed, CurveStyle(THRESHOLD, 1.8)))
    return curves


def error_curves(t_s: Vector, e_s: Vector, e_c: Vector, threshold: Vector | None) -> list[Curve]:
    """Return the norms of both errors, and the trigger's threshold where it is known, (k,) each."""
    curves = [
        Curve(ERRORS, "‖e_c‖ controller", "", t_s, e_c, CurveStyle(CONTROLLER, 3.4)),
        Curve(ERRORS, "‖e_s‖ sensor", "", t_s, e_s, CurveStyle(SENSOR, 1.1)),
    ]
    if threshold is not None:
        curves.append(Curve(ERRORS, "threshold", "", t_s, threshold, CurveStyle(THRESHOLD, 1.8)))
    return curves


def norm_curve(t_s: Vector, norm: Vector, name: str = "‖x‖") -> Curve:
    """Return ‖x‖, or the norm of that name, (k,)."""
    return Curve(STATE_NORM, f"{name} plant", "", t_s, norm, CurveStyle(PLANT, 2.4))


def input_curves(names: Sequence[str], t_s: Vector, u: Matrix) -> list[Curve]:
    """Return m inputs, (k, m), each of which is held until the next."""
    m, colours = len(names), len(palette.SERIES)
    return [
        Curve(
            INPUT,
            name or f"u_{i + 1}",
            "",
            t_s,
            u[:, i],
            CurveStyle(
                palette.SERIES[i % colours],
                # Inputs often coincide: the first ones are wider, and stay visible under the last.
                1.2 + 4.0 * (m - 1 - i) / m,
                DASHES[i // colours % len(DASHES)],
                is_held=True,
            ),
        )
        for i, name in enumerate(names)
    ]


def transmission_curves(event_s: Vector, delivered: NDArray[np.bool_]) -> list[Curve]:
    """Return a point for each transmission (k,): the time since the one before, or since 0."""
    since_s = np.diff(event_s, prepend=0.0)
    dots, crosses = CurveStyle(CONTROLLER, marker="o"), CurveStyle(LOST, marker="x")
    return [
        Curve(INTERVALS, name, "s", event_s[chosen], since_s[chosen], style)
        for name, chosen, style in (("delivered", delivered, dots), ("lost", ~delivered, crosses))
    ]


def bound_curves(bounds: Iterable[tuple[str, Quantity, Vector, Vector, BoundKind]]) -> list[Curve]:
    """Return the curves of bounds; each kind has its colour, each bound of a quantity its dashes.

    A bound has a label, the bounded quantity, times (k,), values (k,) and its source.
    """
    curves, counts = [], Counter[tuple[str, BoundKind]]()
    for label, quantity, t_s, values, kind in bounds:
        colour, dashes = _BOUND_STYLES[kind]
        dash = dashes[counts[quantity, kind] % len(dashes)]
        counts[quantity, kind] += 1
        unit = "s" if quantity == "inter_event" else ""
        style = CurveStyle(colour, 1.6, dash)
        curves.append(Curve(_PANELS.get(quantity, quantity), label, unit, t_s, values, style))
    return curves

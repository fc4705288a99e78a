"""A policy's quadratic comparison between two events, as a polynomial in time.

With z = (x, e_s), a policy compares ‖P z‖² − ‖N z‖² − η with a squared threshold
(:mod:`noack.trigger.trigger_condition`). On a piece of a run z is a Taylor polynomial of degree p
(:mod:`cosim.simulation.batch.taylor`), so the squares are a polynomial of degree 2p. Its
coefficients are Σ_{i+j=k} y_i · S y_j with y = [P; N] z and the diagonal sign matrix S.
η̇ = −λη + ψ has the Taylor coefficients

    η_{k+1} = (ψ_k − λ η_k)/(k + 1).

From degree D = 2p + 1 on, η_{k+1} = −λ η_k/(k + 1), as ψ is a polynomial of degree 2p. The
truncation error after degree q ≥ D is at most |η_q| s^q (λs/(q+1))/(1 − λs/(q+2)). Pieces are so
short that λs ≤ 2. Then each further term is at most 2/(q + 1) times the one before, and for D ≥ 9
_MORE terms reduce the error below 2⁻⁵³ |η_D| s^D: 2²⁰ 9!/29! < 1e-19.

All terms are divided by the square of a number of the state's magnitude, so that values that have
decayed to 1e-150 keep their relative accuracy.
"""

import math
from typing import NamedTuple

import numpy as np

from cosim.simulation.batch.batch_rule import Rule, last_point
from cosim.simulation.batch.level_crossing import estimate, first_root
from cosim.simulation.batch.norm_crossing import NONE, Search, level_at
from cosim.simulation.batch.taylor import HIGHEST, Array, number_and_slope, squared
from cosim.simulation.batch.vector_lanes import Lanes, Width, dot, load, store, times, width
from noack.trigger.trigger_condition import QuadraticForm, error_map
from noack.trigger.trigger_policy import Policy

_MORE = 20
MOST_TERMS = 2 * HIGHEST + 2 + _MORE
"""Largest number of coefficients of the comparison."""
_LEAST_SCALE = 1e-150
_GRAIN = 16 * 2.0**-52
SLOWEST = 2.0
"""Largest λs on a piece."""


class QuadraticCurves(NamedTuple):
    """The quadratic forms of the comparison and of η; matrices in column-major order."""

    rows: Width
    """A tuple; its length is the number of rows of [P; N] including zero rows for padding."""
    form: Array
    """[P; N]: the block for x, then the block for e_s."""
    form_signs: Array
    gain: Array
    """[P_η; N_η]; empty if there is no η."""
    gain_signs: Array
    decay_per_s: float
    """λ."""
    initial_dynamic_variable: float
    y: Array
    """Scratch: coefficients of [P; N] z."""
    w: Array
    """Scratch: coefficients of [P_η; N_η] z."""
    g: Array
    """Scratch: coefficients of the comparison."""
    eta: Array
    """Scratch: coefficients of η."""


def squares_of(policy: Policy, n: int) -> QuadraticCurves | None:
    """Return a policy's comparison; None if it has none or compares ‖W e_s‖ with a threshold."""
    rule = policy.trigger_rule(n)
    form, dynamic_variable = rule.form, rule.dynamic_variable
    if not len(form.up):
        return None
    plain = np.array_equal(form.up, error_map(n, policy.weight)) and not len(form.down)
    if plain and dynamic_variable is None and not rule.from_event and not rule.grid_ns:
        return None
    gain = (
        QuadraticForm(form.up[:0], form.down[:0])
        if dynamic_variable is None
        else dynamic_variable.gain
    )
    rows = max(2 * n, *(len(one.up) + len(one.down) for one in (form, gain)))
    both, signs = _stacked(form, rows)
    gains, gain_signs = _stacked(gain, rows)
    return QuadraticCurves(
        rows=width(rows),
        form=both,
        form_signs=signs,
        gain=np.empty(0) if dynamic_variable is None else gains,
        gain_signs=gain_signs,
        decay_per_s=0.0 if dynamic_variable is None else float(dynamic_variable.decay_per_s),
        initial_dynamic_variable=float(policy.initial_dynamic_variable),
        y=np.empty((HIGHEST + 1) * rows),
        w=np.empty((HIGHEST + 1) * rows),
        g=np.empty(MOST_TERMS),
        eta=np.empty(MOST_TERMS),
    )


def _stacked(form: QuadraticForm, rows: int) -> tuple[Array, Array]:
    """Return [P; N] in column-major order, padded with zeros, and the signs of its rows."""
    signs = np.zeros(rows)
    signs[: len(form.up)], signs[len(form.up) :] = 1.0, -1.0
    both = np.vstack([form.up, form.down])
    filled_up = np.zeros((rows, both.shape[1]))
    filled_up[: len(both)] = both
    return np.ascontiguousarray(filled_up.T).ravel(), signs


def scale_of(largest: float, threshold: float, dynamic_variable: float) -> float:
    """Return a number of the magnitude of the compared values."""
    return max(largest, threshold, math.sqrt(abs(dynamic_variable)), _LEAST_SCALE)


def put(squares: QuadraticCurves, k: int, x: Lanes, e_s: Lanes, factor: float) -> None:
    """Store a coefficient of the state, times a factor."""
    size, area = len(squares.rows), len(squares.form) // 2
    y = times(squares.form, 0, x, squares.rows) + times(squares.form, area, e_s, squares.rows)
    store(squares.y, k * size, y * factor)
    if len(squares.gain) > 0:
        w = times(squares.gain, 0, x, squares.rows) + times(squares.gain, area, e_s, squares.rows)
        store(squares.w, k * size, w * factor)


def compare(squares: QuadraticCurves, p: int, dynamic_variable: float) -> int:
    """Compute the comparison's coefficients from those of the state.

    Returns:
        The degree of the comparison.
    """
    degree = 2 * p
    signs = load(squares.form_signs, 0, squares.rows)
    squared(squares.y, p, signs, squares.g, squares.rows)
    if len(squares.gain) == 0:
        return degree
    signs = load(squares.gain_signs, 0, squares.rows)
    squared(squares.w, p, signs, squares.eta, squares.rows)
    # Compute the coefficients of η from those of its gain, in place.
    last = dynamic_variable
    for k in range(degree + 1 + _MORE):
        gain = squares.eta[k] if k <= degree else 0.0
        squares.eta[k] = last
        last = (gain - squares.decay_per_s * last) / (k + 1)
    squares.eta[degree + 1 + _MORE] = last
    for k in range(degree + 1):
        squares.g[k] -= squares.eta[k]
    for k in range(degree + 1, degree + 2 + _MORE):
        squares.g[k] = -squares.eta[k]
    return degree + 1 + _MORE


def left_side(squares: QuadraticCurves, x: Lanes) -> float:
    """Return ‖P z‖ for e_s = 0."""
    y = times(squares.form, 0, x, squares.rows)
    return math.sqrt(max(dot(y * load(squares.form_signs, 0, squares.rows), y), 0.0))


def first_look(
    squares: QuadraticCurves, level: float, rate: float, dynamic_variable: float
) -> float:
    """Estimate the time of the next event from the first three coefficients of the state."""
    compare(squares, 2, dynamic_variable)
    return estimate(squares.g, level, rate)


def first_event(
    squares: QuadraticCurves, rule: Rule, degree: int, search: Search, point: int, t_s: float
) -> tuple[float, int]:
    """Return the first time at which the comparison holds on a piece.

    Returns:
        The time in seconds from the piece's start, NONE or UNRESOLVED; and the next point of the
        grid.
    """
    if rule.grid_s == 0.0:
        start = load(squares.y, 0, squares.rows)
        grain = dot(start, start) + search.level
        if len(squares.gain) > 0:
            grain += abs(squares.eta[0])
        return first_root(squares.g, degree, search, _GRAIN * grain), point
    last = last_point(rule, t_s + search.end_s)
    while point <= last:
        s = min(max(point * rule.grid_s - t_s, 0.0), search.end_s)
        number, _ = number_and_slope(squares.g, degree, s)
        if number > level_at(search, s):
            return s, point
        point += 1
    return NONE, point


def dynamic_variable_at(squares: QuadraticCurves, p: int, s: float) -> float:
    """Return η, divided by the square of the scale."""
    if len(squares.gain) == 0:
        return 0.0
    number, _ = number_and_slope(squares.eta, 2 * p + 1 + _MORE, s)
    return number

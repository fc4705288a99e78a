"""Measures of a piece of a run (an interval without resets), from its Taylor polynomials.

The cost integrates the polynomials' products exactly. The supremum and the settling time are found
from crossings with a level (:mod:`cosim.simulation.batch.norm_crossing`), without sampling.
"""

import math

from cosim.simulation.batch.batch_data import BatchMemory, BatchSystem
from cosim.simulation.batch.batch_rule import Phase
from cosim.simulation.batch.level_crossing import first_root
from cosim.simulation.batch.norm_crossing import NONE, UNRESOLVED, Search, first_exit, last_entry
from cosim.simulation.batch.taylor import (
    Array,
    Models,
    degree_for,
    largest,
    squared,
    state_at,
    value_and_slope,
)
from cosim.simulation.batch.vector_lanes import Lanes, Width, dot, filled, fma, load, store, times

CERTAINTY = 1e-10
"""The true supremum exceeds the returned one by at most this share."""
_SMALL_SHARE = 1e-27
_LEAST = 1e-150
_LARGEST = 1e150
_CLIMBS = 12
_HALVINGS = 60
_FEW_STEPS = 50
_RISES = 10_000
"""Largest number of rises. Each passes a maximum (a polynomial of degree 24 has few) or rises by
CERTAINTY."""


def square_integrals(
    system: BatchSystem, space: BatchMemory, p: int, s: float, n: Width, m: Width
) -> float:
    """Return ∫₀ˢ xᵀQx + uᵀRu of polynomials of degree p, exact up to rounding.

    With v_k = c_k s^k the integral of xᵀQx is s Σ_{i,j} v_iᵀ Q v_j/(i + j + 1).
    """
    x_scaled, u_scaled, inverse = space.x_scaled, space.u_scaled, system.inverse
    Q, R = system.Q, system.R
    size, inputs, power = len(n), len(m), 1.0
    for k in range(p + 1):
        store(x_scaled, k * size, load(space.x, k * size, n) * power)
        store(u_scaled, k * inputs, load(space.u, k * inputs, m) * power)
        power *= s
    # The last coefficients often contribute nothing to the sum.
    v, w = load(x_scaled, 0, n), load(u_scaled, 0, m)
    negligible = _SMALL_SHARE * (dot(v, v) + dot(w, w))
    while p > 1:
        v, w = load(x_scaled, p * size, n), load(u_scaled, p * inputs, m)
        if dot(v, v) + dot(w, w) > negligible:
            break
        p -= 1
    x_total, u_total = filled(0.0, n), filled(0.0, m)
    for i in range(p + 1):
        # Two independent sums: a single one would stall on the latency of each addition.
        v, w = load(x_scaled, i * size, n), load(u_scaled, i * inputs, m)
        x_sum, u_sum = v * (0.5 * inverse[2 * i + 1]), w * (0.5 * inverse[2 * i + 1])
        x_more, u_more = filled(0.0, n), filled(0.0, m)
        for j in range(i + 1, p, 2):
            x_sum = fma(load(x_scaled, j * size, n), inverse[i + j + 1], x_sum)
            u_sum = fma(load(u_scaled, j * inputs, m), inverse[i + j + 1], u_sum)
            x_more = fma(load(x_scaled, (j + 1) * size, n), inverse[i + j + 2], x_more)
            u_more = fma(load(u_scaled, (j + 1) * inputs, m), inverse[i + j + 2], u_more)
        if i < p and (p - i) % 2 == 1:
            x_more = fma(load(x_scaled, p * size, n), inverse[i + p + 1], x_more)
            u_more = fma(load(u_scaled, p * inputs, m), inverse[i + p + 1], u_more)
        x_sum, u_sum = x_sum + x_more, u_sum + u_more
        x_total = fma(x_sum if len(Q) == 0 else times(Q, 0, x_sum, n), v, x_total)
        u_total = fma(u_sum if len(R) == 0 else times(R, 0, u_sum, m), w, u_total)
    return 2.0 * s * (dot(x_total, filled(1.0, n)) + dot(u_total, filled(1.0, m)))


def raised(
    best: float, curve: Array, p: int, end_s: float, rate: float, growth: float, squares: Array,
    n: Width,
) -> float:  # fmt: skip
    """Return the larger of ``best`` and sup |y(s)| e^{rate s} ``growth`` over [0, ``end_s``].

    The returned value is attained, and the true supremum exceeds it by at most the share CERTAINTY
    (values below 1e-150 are ignored; values above 1e150 are infinite). A curve that stays close to
    one level, such as an oscillation, is searched again as the scalar |y|², in which cancelling
    terms vanish (:mod:`cosim.simulation.batch.level_crossing`). The result is UNRESOLVED if this
    search fails too, or if there are too many rises.
    """
    for _ in range(_RISES):
        if best >= _LARGEST:
            return best
        level = max(best * (1.0 + CERTAINTY), _LEAST) / growth
        s = first_exit(curve, p, Search(level, rate, end_s, False), _FEW_STEPS, n)
        if s == UNRESOLVED:
            squared(curve, p, filled(1.0, n), squares, n)
            s = first_root(squares, 2 * p, Search(level * level, 2.0 * rate, end_s, False), 0.0)
        if s == NONE:
            return best
        if s == UNRESOLVED:
            return UNRESOLVED
        found = _climbed(curve, p, s, end_s, rate, n)
        best = max(best * (1.0 + CERTAINTY), found * growth)
    return UNRESOLVED


def _climbed(curve: Array, p: int, low_s: float, high_s: float, rate: float, n: Width) -> float:
    """Return |y(s)| e^{rate s} at or near a maximum to the right of ``low_s``."""
    y, dy = value_and_slope(curve, p, low_s, n)
    low = dot(y, dy) + rate * dot(y, y)
    best = math.sqrt(dot(y, y)) * math.exp(rate * low_s)
    y, dy = value_and_slope(curve, p, high_s, n)
    high = dot(y, dy) + rate * dot(y, y)
    for _ in range(_CLIMBS):
        # Regula falsi if the slope decreases through 0, otherwise bisection.
        s = 0.5 * (low_s + high_s)
        if low > 0.0 > high:
            s = low_s + (high_s - low_s) * (low / (low - high))
        y, dy = value_and_slope(curve, p, s, n)
        slope = dot(y, dy) + rate * dot(y, y)
        found = math.sqrt(dot(y, y)) * math.exp(rate * s)
        rises = slope > 0.0 and found >= best
        best = max(best, found)
        if rises:
            low_s, low, high = s, slope, 0.5 * high
        else:
            high_s, high, low = s, slope, 0.5 * low
    return best


def last_above(curve: Array, p: int, end_s: float, level: float, ended: Lanes, n: Width) -> float:
    """Return the last s in [0, ``end_s``] at which |y(s)| > ``level``, NONE or UNRESOLVED."""
    square = level * level
    if dot(ended, ended) > square:
        return end_s
    if largest(curve, p, end_s, n) <= square:
        return NONE
    return last_entry(curve, p, level, end_s, n)


def passed_at(space: BatchMemory, end_s: float, limit: float, phase: Phase, n: Width) -> float:
    """Return the time on a piece at which the loop's norm exceeds a limit, at most ``end_s``."""
    low_s, high_s, p = 0.0, end_s, degree_for(space.reach_s, end_s)
    for _ in range(_HALVINGS):
        s = 0.5 * (low_s + high_s)
        level = phase.threshold * math.exp(-phase.rate_per_s * s)
        if is_within(state_at(space, p, s, n), limit, level):
            low_s = s
        else:
            high_s = s
    return high_s


def is_within(state: Models, limit: float, level: float) -> bool:
    """Return whether ‖(x, e_s, e_c)‖ is below ``limit``, and below ``limit`` ``level`` if > 0."""
    x, e_s, e_c = state.x_c - state.e_c, state.e_c + state.d, state.e_c
    if level > 0.0:
        limit *= min(level, 1.0)
    return dot(x, x) + dot(e_s, e_s) + dot(e_c, e_c) < limit * limit

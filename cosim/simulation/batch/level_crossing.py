"""Finds where a scalar polynomial first reaches a decaying level, by steps that skip no crossing.

The method is that of :mod:`cosim.simulation.batch.norm_crossing` for a scalar g:
h(s) = g(s) − c e^{−rs} is followed from a point where it is negative. If |g̈| ≤ b on [s, a] and
c ≥ 0, then

    h(s + δ) ≤ φ(δ) = h(s) + ḣ(s) δ + ½ b δ²,    as ḧ = g̈ − r² c e^{−rs} ≤ b.

φ is convex and negative between 0 and its positive root, so a step up to that root skips no
crossing, however short. Since ḧ ≥ −(b + r² c e^{−rs}) =: −L, h increases on all of [s, a] if
ḣ(s) > L (a − s). Then it has at most one root there, and Newton's method may take any steps that
stay within a bracket.

b = Σ k(k−1) |g_k| a^{k−2} is valid on [0, a]. It is recomputed if a smaller a makes it much
smaller. Nothing is sampled. Only rounding remains: a tangency is detected or missed if h differs
from 0 by less than the rounding error.

If h starts at 0 and decreases, as for an envelope that starts at the event, the first step is
−2ḣ/b. If h starts above 0, or at 0 and increases, the event is at the start.

Termination: a step either advances or is too short to change s in floating point, which ends the
search; MOST_STEPS also ends it. Newton's method takes at most NEWTON_STEPS; then its bracket is
bisected to the last bit.
"""

import math

from cosim.simulation.batch.norm_crossing import (
    MOST_STEPS,
    NONE,
    UNRESOLVED,
    Point,
    Search,
    ascent,
    excess_and_slope,
    level_at,
)
from cosim.simulation.batch.taylor import Array

_AHEAD = 3.0
_NEARER = 0.6


def first_root(g: Array, degree: int, search: Search, grain: float) -> float:
    """Return the first s in [0, ``end_s``) from which g(s) ≥ c e^{−rs}, NONE or UNRESOLVED."""
    rate, end_s = search.rate, search.end_s
    s, ahead_s = 0.0, end_s
    most = bend_of(g, degree, end_s)
    value, slope = g[0] - search.level, g[1] + rate * search.level
    if value > grain or (value >= -grain and slope > 0.0):
        return 0.0
    if end_s <= 0.0:
        return NONE
    value = min(value, 0.0)
    for _ in range(MOST_STEPS):
        if slope > (most + rate * rate * level_at(search, s)) * (ahead_s - s):
            s = ascent(g, degree, search, Point(s, value, slope), ahead_s, None)
            if s != NONE or ahead_s == end_s:
                return s
            s = ahead_s
        else:
            step = safe_step(value, slope, most, ahead_s - s)
            if s + step >= end_s:
                return NONE
            if s + step <= s:
                return s
            s = min(s + step, ahead_s)
            if s + _AHEAD * step < _NEARER * ahead_s:
                ahead_s = s + _AHEAD * step
                most = bend_of(g, degree, ahead_s)
        if s == ahead_s:
            ahead_s = end_s
            most = bend_of(g, degree, ahead_s)
        value, slope = excess_and_slope(g, degree, search, s, None)
        if value >= 0.0:
            return s
    return UNRESOLVED


def safe_step(value: float, slope: float, most: float, span: float) -> float:
    """Return φ's positive root, given φ(0) ≤ 0, or ``span`` if that is smaller."""
    if value + span * (slope + 0.5 * most * span) <= 0.0:
        return span
    root = math.sqrt(slope * slope - 2.0 * most * value)
    if slope > 0.0:
        return min(-2.0 * value / (slope + root), span)
    return min((root - slope) / most, span)


def estimate(g: Array, level: float, rate: float) -> float:
    """Return the root of h's approximation by three coefficients; infinity if there is none."""
    value, slope = g[0] - level, g[1] + rate * level
    half = g[2] - 0.5 * rate * rate * level
    square = slope * slope - 4.0 * half * min(value, 0.0)
    if square < 0.0:
        return math.inf
    if slope > 0.0:
        return -2.0 * min(value, 0.0) / (slope + math.sqrt(square))
    return (math.sqrt(square) - slope) / (2.0 * half) if half > 0.0 else math.inf


def bend_of(g: Array, degree: int, s: float) -> float:
    """Return a bound on |g̈| in [0, s]: the second derivative of Σ |g_k| s^k."""
    total = 0.0
    for k in range(degree, 1, -1):
        total = total * s + k * (k - 1.0) * abs(g[k])
    return total * (1.0 + 1e-9)

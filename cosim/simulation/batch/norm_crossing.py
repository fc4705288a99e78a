"""Finds where a polynomial curve first reaches a threshold, by steps that skip no crossing.

h(s) = |y(s)| − c e^{−rs} is followed from a point where it is negative. If |ÿ| ≤ b on [s, a], then

    h(s + δ) ≤ φ(δ) = |y(s) + ẏ(s) δ| + ½ b δ² − c_s (1 − r δ),    c_s = c e^{−rs}.

φ is convex. If φ(0) < 0 and φ(δ) ≤ 0, then φ and h are negative in between, so a step of length δ
skips no crossing, however short. Newton's method from the right stays right of φ's root. The chord
from its last point to (0, φ(0)) is zero at a point left of the root: this point is the step.

If y ≠ 0, ḧ = (|ẏ|² − (y·ẏ/|y|)² + y·ÿ)/|y| − r² c e^{−rs} ≥ −(b + r² c_s) =: −L. If y = 0, the
kink of |y| only increases ḣ. So if ḣ(s) > L (a − s), h increases on all of [s, a]. Then it has at
most one root there, and Newton's method may take any steps that stay within the interval.

b is :func:`cosim.simulation.batch.taylor.bend` and valid on [0, a]. It is recomputed if a smaller a
makes it much smaller. Nothing is sampled. Only rounding remains: if h is below 0 by less than the
rounding error, steps have about 1e-8 of the curve's time scale, and a tangency in floating point is
detected or missed. The backward search is the same search on s ↦ y(end − s).

Termination: a step either advances or is too short to change s in floating point, which ends the
search. A curve that stays just below its threshold may need very many steps; after MOST_STEPS the
result is UNRESOLVED. A chord of φ lies above φ, so Newton's method may stop at any iteration: the
step is then shorter and equally safe. Where h increases, Newton's method takes at most
NEWTON_STEPS; then its bracket is bisected to the last bit.

In all functions ``curve`` has the coefficients of y, p is its degree, n the number of its entries;
``most``, ``limit`` and ``span`` are b, c_s and a − s.

This module compares |y| only. Other quadratic event functions are in
:mod:`cosim.simulation.batch.quadratic_crossing`.
"""

import math
from typing import NamedTuple

from cosim.simulation.batch.taylor import Array, bend, number_and_slope, value_and_slope
from cosim.simulation.batch.vector_lanes import Lanes, Width, dot, filled, load

NONE = -1.0
UNRESOLVED = -2.0
MOST_STEPS = 1_000_000
"""They take about 50 ms."""
CLOSE = 1e-8
"""Relative size of Newton's last step; its square is below rounding."""
_AHEAD = 3.0
_NEARER = 0.6
NEWTON_STEPS = 60
TURNS = NEWTON_STEPS + 1100
"""More bisections than any two floating-point numbers need."""


class Search(NamedTuple):
    """A search on [0, ``end_s``] for the first crossing of c e^{−rs}."""

    level: float
    """c > 0."""
    rate: float
    """r ≥ 0, per second; 0 if ``backward``."""
    end_s: float
    backward: bool
    """Search y(``end_s`` − s) instead of y(s)."""


class Point(NamedTuple):
    """A point of the search."""

    s: float
    excess: float
    """h(s)."""
    slope: float
    """ḣ(s)."""


def level_at(search: Search, s: float) -> float:
    """Return c e^{−rs}."""
    return search.level * math.exp(-search.rate * s) if search.rate > 0.0 else search.level


def first_exit(curve: Array, p: int, search: Search, most_steps: int, n: Width) -> float:
    """Return the first s in [0, ``end_s``) from which |y(s)| ≥ c e^{−rs}, NONE or UNRESOLVED."""
    rate, end_s, backward = search.rate, search.end_s, search.backward
    s, ahead_s = 0.0, end_s
    most = bend(curve, p, end_s, n)
    if backward:
        y, dy = look(curve, p, search, s, n)
    else:
        y, dy = load(curve, 0, n), load(curve, len(n), n)
    for _ in range(most_steps):
        square, mixed, speed = dot(y, y), dot(y, dy), dot(dy, dy)
        limit = level_at(search, s)
        size = math.sqrt(square)
        if size >= limit:
            return s
        if s >= end_s:
            return NONE
        slope = rate * limit + (mixed / size if size > 0.0 else math.sqrt(speed))
        if slope > (most + rate * rate * limit) * (ahead_s - s):
            s = ascent(curve, p, search, Point(s, size - limit, slope), ahead_s, n)
            if s != NONE or ahead_s == end_s:
                return s
            s = ahead_s
        else:
            step = safe(square, mixed, speed, limit, rate, most, ahead_s - s)
            if s + step >= end_s:
                return NONE
            if s + step <= s:
                return s
            s = min(s + step, ahead_s)
            if s + _AHEAD * step < _NEARER * ahead_s and not backward:
                ahead_s = s + _AHEAD * step
                most = bend(curve, p, ahead_s, n)
        if s == ahead_s:
            ahead_s = end_s
            most = bend(curve, p, ahead_s, n)
        y, dy = look(curve, p, search, s, n)
    return UNRESOLVED


def safe(
    square: float, mixed: float, speed: float, limit: float, rate: float, most: float, span: float
) -> float:
    """Return the length of a step that skips no crossing; ``span`` if there is none within it."""
    length, below = span, limit - math.sqrt(square)
    above = 0.0
    for _ in range(NEWTON_STEPS):
        straight = math.sqrt(max(square + length * (2.0 * mixed + length * speed), 0.0))
        above = straight + limit * (rate * length - 1.0) + 0.5 * most * length * length
        if above <= 0.0:
            return length
        slope = limit * rate + most * length
        if straight > 0.0:
            slope += (mixed + length * speed) / straight
        if above <= below:
            return length * (below / (below + above))
        following = length - above / slope
        if not 0.0 < following < length:
            return 0.0
        length = following
    return length * (below / (below + above))


def ascent(
    curve: Array, p: int, search: Search, start: Point, ahead_s: float, n: Width | None
) -> float:
    """Return the root of an increasing h in (``start.s``, ``ahead_s``), or NONE."""
    s, excess, slope = start.s, start.excess, start.slope
    low_s, high_s, beyond = s, ahead_s, False
    for turn in range(TURNS):
        following = s - excess / slope if slope > 0.0 else math.inf
        if abs(following - s) <= CLOSE * s and turn < NEWTON_STEPS:
            return following if following < ahead_s or beyond else NONE
        following = bracketed(following, turn, low_s, high_s, beyond)
        if following == s:
            return s
        s = following
        excess, slope = excess_and_slope(curve, p, search, s, n)
        if excess >= 0.0:
            high_s, beyond = s, True
        elif s == ahead_s:
            return NONE
        else:
            low_s = s
    return s


def bracketed(following: float, turn: int, low_s: float, high_s: float, beyond: bool) -> float:
    """Return Newton's point ``following`` if it is in the bracket, else a safe one.

    ``low_s`` is below the root, if there is one; there is one below ``high_s`` if ``beyond``.
    """
    if turn < NEWTON_STEPS and low_s < following < high_s:
        return following
    if not beyond and (turn >= NEWTON_STEPS or following >= high_s):
        return high_s
    return 0.5 * (low_s + high_s)


def excess_and_slope(
    curve: Array, p: int, search: Search, s: float, n: Width | None
) -> tuple[float, float]:
    """Return h(s) and ḣ(s), for |y| or for a scalar polynomial."""
    limit = level_at(search, s)
    if n is None:
        number, slope = number_and_slope(curve, p, s)
        return number - limit, slope + search.rate * limit
    y, dy = look(curve, p, search, s, n)
    size = math.sqrt(dot(y, y))
    return size - limit, search.rate * limit + (dot(y, dy) / size if size > 0.0 else 0.0)


def look(curve: Array, p: int, search: Search, s: float, n: Width) -> tuple[Lanes, Lanes]:
    """Return y and ẏ, forward or backward."""
    if search.backward:
        y, dy = value_and_slope(curve, p, search.end_s - s, n)
        return y, filled(0.0, n) - dy
    return value_and_slope(curve, p, s, n)


def last_entry(curve: Array, p: int, level: float, end_s: float, n: Width) -> float:
    """Return the last s in [0, ``end_s``] with |y(s)| ≥ ``level``, NONE or UNRESOLVED."""
    back_s = first_exit(curve, p, Search(level, 0.0, end_s, True), MOST_STEPS, n)
    return back_s if back_s < 0.0 else end_s - back_s

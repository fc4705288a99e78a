"""Finds the first time at which ∫‖y‖dτ exceeds a decaying threshold, on a piece of a run.

The integral never decreases and the threshold never increases, so they cross at most once and no
crossing can be missed. On a piece y is a Taylor polynomial (:mod:`cosim.simulation.batch.taylor`).
∫‖y‖ is computed by Gauss-Legendre quadrature with 8 nodes, on intervals that are halved until the
halves agree with the whole to TOLERANCE of the integral so far. The crossing is found by bisection,
to the last bits of the time on the piece.
"""

import math

from cosim.simulation.batch.norm_crossing import NONE, UNRESOLVED, Search
from cosim.simulation.batch.taylor import Array, value
from cosim.simulation.batch.vector_lanes import Width, dot

TOLERANCE = 1e-13
_NODES = (0.18343464249564978, 0.525532409916329, 0.7966664774136267, 0.9602898564975362)
"""The positive nodes on [−1, 1]."""
_WEIGHTS = (0.36268378337836166, 0.3137066458778869, 0.22238103445337443, 0.10122853629037706)
_SHORTEST = 1e-9
"""Shortest interval that is halved, as a share of the piece."""
_MOST_INTERVALS = 100_000
_BISECTIONS = 60


def gauss(curve: Array, p: int, begin_s: float, end_s: float, n: Width) -> float:
    """Return the quadrature of ‖y‖ over [``begin_s``, ``end_s``]."""
    middle, half, total = 0.5 * (begin_s + end_s), 0.5 * (end_s - begin_s), 0.0
    for i in range(len(_NODES)):
        y = value(curve, p, middle - half * _NODES[i], n)
        total += _WEIGHTS[i] * math.sqrt(dot(y, y))
        y = value(curve, p, middle + half * _NODES[i], n)
        total += _WEIGHTS[i] * math.sqrt(dot(y, y))
    return half * total


def first_excess(
    curve: Array, p: int, search: Search, integral: float, n: Width
) -> tuple[float, float]:
    """Return the first time at which the integral exceeds the level of a search.

    Returns:
        The time in seconds from the start of the piece, NONE or UNRESOLVED; and the integral at
        that time, or at the end.
    """
    end_s = search.end_s
    if integral > search.level:
        return 0.0, integral
    s, step = 0.0, end_s
    for _ in range(_MOST_INTERVALS):
        if s >= end_s:
            return NONE, integral
        following = min(s + step, end_s)
        middle = 0.5 * (s + following)
        gained = gauss(curve, p, s, middle, n) + gauss(curve, p, middle, following, n)
        error = abs(gained - gauss(curve, p, s, following, n))
        if error > TOLERANCE * (integral + gained) and step > _SHORTEST * end_s:
            step = 0.5 * (following - s)
        elif integral + gained > search.level * math.exp(-search.rate * following):
            return crossing(curve, p, search, integral, s, following, n)
        else:
            integral += gained
            s, step = following, 2.0 * step
    return UNRESOLVED, integral


def crossing(
    curve: Array, p: int, search: Search, integral: float, begin_s: float, end_s: float, n: Width
) -> tuple[float, float]:
    """Return the crossing, as :func:`first_excess`, where one quadrature is exact."""
    low_s, high_s = begin_s, end_s
    for _ in range(_BISECTIONS):
        middle_s = 0.5 * (low_s + high_s)
        if not low_s < middle_s < high_s:
            break
        reached = integral + gauss(curve, p, begin_s, middle_s, n)
        if reached > search.level * math.exp(-search.rate * middle_s):
            high_s = middle_s
        else:
            low_s = middle_s
    return high_s, integral + gauss(curve, p, begin_s, high_s, n)

"""Inequalities v ≤ F v + g between non-negative numbers, F ≥ 0 and g ≥ 0, as in small-gain proofs.

If some w > 0 has F w < w, the spectral radius of F is below 1, and v ≤ x for every x with
x − F x ≥ g. Both are checked with a bound of all rounding, so nothing depends on how w and x were
computed. x begins as the computed (I − F)⁻¹ g. Where x − F x misses g by r, adding
w max r/(w − F w) is enough.
"""

import math
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector

_EPSILON = float(np.finfo(float).eps)


class Solution(NamedTuple):
    """The bound of v, if there is one."""

    loop_gain: float
    """1 minus the smallest leading principal minor of I − F; below 1 if and only if ρ(F) < 1. If it
    is not below 1: at least the largest entry of the diagonal."""
    bound: Vector | None
    """Upper bound of v, (k,); None if ρ(F) < 1 was not confirmed."""


def solve_inequalities(F: Matrix, g: Vector) -> Solution:
    """Return the smallest bound of v that follows, for F of shape (k, k) and g of shape (k,)."""
    F = np.where(F.any(axis=1) | (g > 0), F, 0.0)  # a signal that is 0 affects nothing
    sizes = g + F @ (g + F @ g)  # a right side of the size of x makes w/x dimensionless
    least = sizes[sizes > 0].min(initial=math.inf)
    least = least if math.isfinite(least) else 1.0
    remainder = np.eye(len(g)) - F
    minors, (x, w) = _eliminated(remainder, g, np.where(sizes > 0, sizes, least))
    loop_gain = 1 - min(minors)
    if not loop_gain < 1:
        minors = [np.linalg.det(remainder[:k, :k]) for k in range(1, len(g) + 1)]
        gains = [1 - min(minors), *np.diagonal(F)]
        return Solution(max(1.0, *gains) if np.isfinite(gains).all() else math.inf, None)
    rounding = (len(g) + 4) * _EPSILON
    moved_x, moved_w = F @ x, F @ w
    slack = w - moved_w - rounding * (w + moved_w)
    if not (w > 0).all() or not (slack > 0).all():
        return Solution(loop_gain, None)
    missing = moved_x + g - x + rounding * (moved_x + g + x)
    bound = x + w * max(float((missing / slack).max()), 0.0) * (1 + rounding)
    return Solution(loop_gain, np.where(F.any(axis=1), bound, g))


def _eliminated(matrix: Matrix, *right_sides: Vector) -> tuple[list[float], list[Vector]]:
    """Return the leading principal minors up to the first one not above 0, and the solutions.

    The elimination is that of Gauss without exchanges, in floats: the matrices are tiny.
    """
    size, minors = len(matrix), [1.0]
    rows = np.column_stack([matrix, *right_sides]).tolist()
    for k in range(size):
        minors.append(minors[-1] * rows[k][k])
        if not minors[-1] > 0:
            return minors, [np.full(size, np.nan) for _ in right_sides]
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for i in range(size):
            if i != k and (share := rows[i][k]):
                rows[i] = [value - share * own for value, own in zip(rows[i], rows[k], strict=True)]
    return minors[1:], list(np.array(rows)[:, size:].T)

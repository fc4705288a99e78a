"""Inequalities v ≤ F v + g between non-negative numbers, F ≥ 0 and g ≥ 0, as in small-gain proofs.

If some w > 0 has F w < w, the spectral radius of F is below 1, and v ≤ x for every x with
x − F x ≥ g. Both are checked with a bound of all rounding, so nothing depends on how w and x were
computed. x begins as the computed (I − F)⁻¹ g. Where x − F x misses g by r, adding
w max r/(w − F w) is enough.
"""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector

_EPSILON = float(np.finfo(float).eps)


class Solution(NamedTuple):
    """The bound of v, if there is one."""

    loop_gain: float
    """1 minus the smallest leading principal minor of I − F; below 1 if and only if ρ(F) < 1."""
    bound: Vector | None
    """Upper bound of v, (k,); None if ρ(F) < 1 was not confirmed."""


def solve_inequalities(F: Matrix, g: Vector) -> Solution:
    """Return the smallest bound of v that follows, for F of shape (k, k) and g of shape (k,)."""
    remainder = np.eye(len(g)) - F
    minors = [float(np.linalg.det(remainder[:k, :k])) for k in range(1, len(g) + 1)]
    loop_gain = 1 - min(minors)
    if not loop_gain < 1:
        return Solution(loop_gain if loop_gain >= 1 else np.inf, None)
    try:
        x = np.maximum(np.linalg.solve(remainder, g), 0.0)
        # A right side of the size of x makes w/x dimensionless.
        w = np.linalg.solve(remainder, np.where(x > 0, x, 1.0))
    except np.linalg.LinAlgError:
        return Solution(loop_gain, None)
    rounding = (len(g) + 4) * _EPSILON
    slack = w - F @ w - rounding * (w + F @ w)
    if not ((w > 0).all() and (slack > 0).all()):
        return Solution(loop_gain, None)
    missing = F @ x + g - x + rounding * (F @ x + g + x)
    return Solution(loop_gain, x + w * max(float((missing / slack).max()), 0.0) * (1 + rounding))

"""The bound that a trigger rule sets to the sensor's error, whatever the plant and the network do.

Where the comparison was made and did not transmit, zᵀQz ≤ f², with z = (x, e_s), Q = PᵀP − NᵀN and
the threshold f. Let Q₂₂ = FᵀF be its part on e_s, J = Q₂₂⁻¹Q₂₁, and CᵀC ⪰ Q₁₂J − Q₁₁. Then

    ‖F(e_s + Jx)‖² ≤ f² + ‖C x‖²,   so   ‖W e_s‖ ≤ ‖W F⁻¹‖ (f + ‖C x‖) + ‖W J x‖.

If Q₂₂ is not positive definite, the comparison leaves e_s unbounded in some direction. The same
holds with Girard's η, and where the threshold is what the state was at the last event.
"""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_rule import QuadraticForm, TriggerRule

_ROUNDING = 1.0 + 1e-9
_RELATIVE, _RESIDUAL = 1e-7, 1e-13
"""Least eigenvalue of a positive definite Q₂₂, and the error of a computed Q, as shares of ‖Q‖."""


class ComparisonBound(NamedTuple):
    """‖W e_s‖ ≤ ``size`` · f + Σ ‖S x‖, after an event, or a comparison with f that was none."""

    size: float
    shares: tuple[Matrix, ...]
    """S, (k, n) each."""
    least: float
    """An event needs ‖W e_s‖ > ``least`` · f, unless it is due by its time; 0 if nothing is known.
    """


def comparison_bound(rule: TriggerRule, weight: Matrix) -> ComparisonBound | None:
    """Return the bound of ‖W e_s‖ that the comparison of a rule sets; None if it sets none.

    ``weight`` is W, (n, n). A rule that integrates compares ∫‖P z‖ instead of ‖P z‖.
    """
    if rule.from_event or rule.dynamic_variable is not None:
        return None
    n, (up, down) = len(weight), rule.form
    if not len(up):
        return None
    if up[:, :n].any() or down[:, n:].any():
        return _of_mixed_form(rule.form, weight)
    P, N = up[:, n:], down[:, :n]
    if np.array_equal(P, weight):
        return ComparisonBound(1.0, (N,) if N.any() else (), 1.0)
    if not _is_definite(P.T @ P, 1.0):
        return None
    size = float(np.linalg.norm(weight @ np.linalg.pinv(P), 2)) * _ROUNDING
    least = 1 / (float(np.linalg.norm(P @ np.linalg.inv(weight), 2)) * _ROUNDING)
    return ComparisonBound(size, (size * N,) if N.any() else (), least)


def _of_mixed_form(form: QuadraticForm, weight: Matrix) -> ComparisonBound | None:
    """Return the bound of a form that compares e_s together with x."""
    n = len(weight)
    Q = form.up.T @ form.up - form.down.T @ form.down
    size_of_Q = float(np.linalg.norm(form.up, 2) ** 2 + np.linalg.norm(form.down, 2) ** 2)
    if not _is_definite(Q[n:, n:], size_of_Q):
        return None
    J = np.linalg.solve(Q[n:, n:], Q[n:, :n])
    values, vectors = np.linalg.eigh(Q[:n, n:] @ J - Q[:n, :n])
    grown = values + _RESIDUAL / _RELATIVE * size_of_Q
    C = np.sqrt(grown[grown > 0])[:, None] * vectors.T[grown > 0]
    F = np.linalg.cholesky(Q[n:, n:]).T
    size = float(np.linalg.norm(weight @ np.linalg.inv(F), 2)) * _ROUNDING
    shares = (size * C, _ROUNDING * weight @ J)
    return ComparisonBound(size, tuple(S for S in shares if S.any()), 0.0)


def _is_definite(Q: Matrix, size: float) -> bool:
    """Return whether a symmetric Q is positive definite beyond rounding, (n, n)."""
    values = np.linalg.eigvalsh(Q)
    return bool(values[0] > _RELATIVE * max(size, float(values[-1])))

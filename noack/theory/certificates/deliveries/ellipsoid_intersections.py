"""Bounds of ‖Y z‖ over an intersection of ellipsoids, zᵀQ_i z ≤ 1 for several forms Q_i.

With weights w_i ≥ 0 of sum 1, all these z are in the ellipsoid zᵀQz ≤ 1, Q = Σ w_i Q_i. So ‖Y z‖² is
at most the largest eigenvalue of Y Q⁻¹ Yᵀ, whatever the weights are. They are improved in rounds:
forms that are large at the z of this eigenvalue get more weight. This z, scaled into all ellipsoids,
shows how small a bound can become at best. The constants of the search trade time against the size
of the bounds.
"""

import math
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.certificates.deliveries.delivery_flow import FLOW_ROUNDING

_MOST_ROUNDS = 40
"""Limit of the rounds; then a bound is used as it is."""
_POWER = 0.3
"""Weights are multiplied by this power of their form at the worst z; below 1, it damps the search."""
_LEAST_WEIGHT = 1e-9
"""No weight is smaller, so that each form can regain weight."""
_WEIGHT_OF_OTHERS = 0.1
"""Sum of the first weights of the forms that are not expected to matter."""
_NEARLY_LARGEST = 0.97
"""Bounds below this share of the largest one are not improved if only the largest counts."""
_NEARLY_OPTIMAL = 1 + 1e-5
"""A bound is not improved further if no weights make it smaller by more than this factor."""
LEAST_CONDITION = 1e-10
"""Smallest over largest eigenvalue of a Q that is used: the error of its inverse is then about 1e-6,
less than ``FLOW_ROUNDING`` allows for."""


class Wanted(Enum):
    """The bounds that are improved, of several."""

    ALL = "all of them"
    LARGEST = "those that are nearly as large as the largest one"
    SMALLEST = "those that may become the smallest one"


def bound_outputs(
    forms: Stack,
    Y: Stack,
    enough: Vector | float,
    first_weights: Stack | None = None,
    *,
    wanted: Wanted = Wanted.LARGEST,
    cap: Vector | float = math.inf,
    added: Vector | float = 0.0,
    most: float = math.inf,
) -> tuple[Vector, Stack]:
    """Bound the outputs of several intersections, each with an output of its own.

    Args:
        forms: Q_i of each intersection, (j, i, m, m).
        Y: its output matrix, (j, q, m).
        enough: no bound below this is improved.
        first_weights: where the search begins, (j, i); by default all are equal.
        wanted: which bounds are improved.
        cap: bounds above this count as this.
        added: what is added to each bound before it is compared.
        most: a bound that cannot become at most this is not improved.

    Returns:
        The bounds, (j,), infinite where Q is too flat, and their weights, (j, i).
    """
    if first_weights is None:
        first_weights = np.full(forms.shape[:2], 1 / forms.shape[1])
    weights, best_weights = first_weights.copy(), first_weights.copy()
    bounds = np.full(len(forms), np.inf)
    possible = np.zeros(len(forms))
    active = np.arange(len(forms))
    for _ in range(_MOST_ROUNDS):
        # The bounds by these weights.
        chosen = forms[active]
        Z = np.linalg.solve(np.einsum("ji,jiab->jab", weights[active], chosen), Y[active].swapaxes(1, 2))
        values, vectors = np.linalg.eigh(Y[active] @ Z)
        norms = np.sqrt(values[:, -1].clip(min=0.0)) * FLOW_ROUNDING
        better = norms < bounds[active]
        best_weights[active[better]] = weights[active[better]]
        bounds[active] = np.minimum(bounds[active], norms)
        # The forms of the z with the largest ‖Y z‖: those above the mean need more weight.
        z = (Z @ vectors[:, :, -1:])[..., 0]
        of_z = np.einsum("ja,jiab,jb->ji", z, chosen, z).clip(min=0.0)
        largest = of_z.max(axis=1).clip(min=1e-300)
        # Scaled to forms of at most 1, this z is possible, whatever the weights are.
        possible[active] = np.maximum(possible[active], values[:, -1] / np.sqrt(largest))
        weights[active] *= (of_z / largest[:, None]) ** _POWER
        weights = weights.clip(min=_LEAST_WEIGHT)
        weights /= weights.sum(axis=1, keepdims=True)
        totals = np.minimum(bounds, cap) + added
        may_become_smaller = bounds > _NEARLY_OPTIMAL * possible
        active = np.flatnonzero(
            may_become_smaller & _is_wanted(wanted, totals, possible + added, enough, most)
        )
        if not len(active):
            break
    sums = np.linalg.eigvalsh(np.einsum("ji,jiab->jab", best_weights, forms))
    bounds[~(sums[:, 0] > LEAST_CONDITION * sums[:, -1])] = np.inf
    return bounds, best_weights


def _is_wanted(
    wanted: Wanted, totals: Vector, possible: Vector, enough: Vector | float, most: float
) -> NDArray[np.bool_]:
    """Return which bounds are improved, given values that are possible, (j,)."""
    if wanted is Wanted.LARGEST:
        enough = np.maximum(enough, _NEARLY_LARGEST * float(totals.max()))
    elif wanted is Wanted.SMALLEST:
        if (totals <= enough).any():
            return np.zeros(len(totals), dtype=bool)
        most = min(most, float(totals.min()))
    return np.asarray((totals > enough) & (possible <= most))


def weights_favouring(forms: Stack, chosen: list[int], shares: Matrix) -> Matrix:
    """Return first weights, (j, i): shares, (j, chosen), of chosen forms, and a little for all of them."""
    weights = np.full(forms.shape[:2], _WEIGHT_OF_OTHERS / forms.shape[1])
    weights[:, chosen] += (1 - _WEIGHT_OF_OTHERS) * shares
    return weights


def balancing_coordinates(rows: Stack) -> Stack:
    """Return coordinates in which the sum of the squares of rows is the identity, (j, m, m).

    ``rows`` is (j, i, q, m). The squares themselves may be too different for their rounding.
    """
    together = rows.reshape(len(rows), -1, rows.shape[-1])
    return np.asarray(np.linalg.inv(np.linalg.qr(together, mode="r")))

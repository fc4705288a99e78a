"""A time-triggered loop with random losses: its growth in mean square.

From one transmission to the next the state z = (x, x_c, u, w) of the loop becomes M₀z if the update
is delivered and M₁z if it is lost. The outcomes are a chain of states; P_ij is the probability that
state j follows state i and the update is delivered, L_ij the same for a loss. The second moments
X_j = E[z zᵀ; state j] therefore follow

    X_j ← Σ_i (L_ij M₁ X_i M₁ᵀ + P_ij M₀ X_i M₀ᵀ),

and E‖z‖² grows exactly like the powers of this operator's spectral radius. Almost surely, ‖z‖ grows
per period by at most the root of that; :mod:`noack.theory.random_losses.random_growth` has a
smaller bound.
"""

from collections.abc import Sequence
from functools import reduce

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.impairments.loss_prediction import OutcomeChain
from noack.impairments.markov_chain import NotPredictableError
from noack.theory.bounds.contraction import EPSILON, Stack
from noack.theory.margins.exact_matrices import exactly
from noack.theory.margins.switched_system import Edge, SwitchedSystem

_MOST_ENTRIES = 2000
"""Largest size of the operator's matrix."""
_ABOVE = (1e-7, 1e-6, 1e-5, 1e-4)
"""The bound of the spectral radius is the first of these shares that the check confirms above the
computed one."""


def mean_square_growth(maps: Sequence[tuple[Matrix, Matrix]], outcomes: OutcomeChain) -> float:
    """Return the growth of √(E‖z‖²) per period, as an upper bound that is exact up to 1e-6.

    Args:
        maps: M₀ (delivered) and M₁ (lost), (N, N) each, for every slot: period k uses the pair
            k modulo their number.
        outcomes: of the updates.

    Raises:
        NotPredictableError: there are too many states.
    """
    turned = balanced_maps(maps)
    steps = (second_moments(delivered, lost, outcomes) for delivered, lost in turned)
    operator = reduce(lambda before, step: step @ before, steps)
    return float(bounded_radius(operator, len(turned[0][0])) ** (0.5 / len(maps)))


def balanced_maps(maps: Sequence[tuple[Matrix, Matrix]]) -> list[tuple[Matrix, Matrix]]:
    """Return the maps in coordinates of their common range, to rounding.

    In these coordinates no direction grows much more than others, so that the check of
    :func:`bounded_radius` is accurate.
    """
    stack = np.array(maps)
    size = stack.shape[-1]
    U, singular, _ = np.linalg.svd(stack.transpose(2, 0, 1, 3).reshape(size, -1))
    rank = max(int((singular > 10 * size * EPSILON * singular[0]).sum()), 1)
    stack = U[:, :rank].T @ stack @ U[:, :rank]
    edges = tuple(Edge(0, 0, exactly(one)) for slot in stack for one in slot)
    T = SwitchedSystem(edges).balancing()[0]
    stack = T @ stack @ np.linalg.inv(T)
    return [(delivered, lost) for delivered, lost in stack]


def bounded_radius(operator: Matrix, size: int) -> float:
    """Return an upper bound of the spectral radius of an operator, mostly exact up to 2e-7.

    Args:
        operator: as :func:`second_moments` returns it.
        size: of each X_j.

    Raises:
        NotPredictableError: it cannot be computed.
    """
    if not np.isfinite(operator).all():
        raise NotPredictableError("the loop's second moments exceed 1e308 within a few periods")
    radius = float(np.abs(np.linalg.eigvals(operator)).max())
    for above in _ABOVE:
        if radius == 0 or _is_below(operator, radius * (1 + above), size):
            return radius * (1 + 2 * above)
    raise NotPredictableError("the second moments could not be bounded numerically")


def second_moments(delivered: Matrix, lost: Matrix, outcomes: OutcomeChain) -> Matrix:
    """Return the operator of one period on the stacked upper triangles of X_j.

    Raises:
        NotPredictableError: there are too many states.
    """
    size = len(delivered)
    if len(outcomes.lost) * size * (size + 1) // 2 > _MOST_ENTRIES:
        raise NotPredictableError("loop and losses together have too many states to compute with")
    operator = np.kron(outcomes.lost.T, _on_triangle(lost))
    return np.asarray(operator + np.kron(outcomes.delivered.T, _on_triangle(delivered)))


def _on_triangle(matrix: Matrix) -> Matrix:
    """Return the map of the upper triangle of X to that of M X Mᵀ."""
    i, j = np.triu_indices(len(matrix))
    straight = matrix[np.ix_(i, i)] * matrix[np.ix_(j, j)]
    return np.asarray(straight + matrix[np.ix_(i, j)] * matrix[np.ix_(j, i)] * (i != j))


def from_triangles(entries: Vector, size: int) -> Stack:
    """Return the symmetric matrices with these upper triangles, (number, size, size)."""
    i, j = np.triu_indices(size)
    stack = np.zeros((len(entries) // len(i), size, size))
    stack[:, i, j] = stack[:, j, i] = entries.reshape(-1, len(i))
    return stack


def triangles(stack: Stack) -> Vector:
    """Return the upper triangles of symmetric matrices, one after the other."""
    i, j = np.triu_indices(stack.shape[-1])
    return stack[:, i, j].ravel()


def _is_below(operator: Matrix, bound: float, size: int) -> bool:
    """Return whether X_j > 0 with operator(X) < bound X prove that a bound is one, to rounding."""
    modes = 2 * len(operator) // (size * (size + 1))
    identity = triangles(np.tile(np.eye(size), (modes, 1, 1)))
    resolvent = bound * np.eye(len(operator)) - operator
    solution = np.asarray(np.linalg.solve(resolvent, identity), dtype=np.float64)
    forms, images = (from_triangles(part, size) for part in (solution, operator @ solution))
    rounding = 1e-13 * len(operator) * float(np.abs(forms).max()) * max(bound, 1.0)
    parts = (forms, bound * forms - images)
    return all(float(np.linalg.eigvalsh(part).min()) > rounding for part in parts)

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
from typing import TYPE_CHECKING

import numpy as np

from noack.core.linear_systems import Matrix, Vector, balancing_exponents
from noack.impairments.loss_prediction import OutcomeChain
from noack.impairments.markov_chain import NotPredictableError
from noack.theory.bounds.contraction import EPSILON, Stack
from noack.theory.margins.exact_matrices import exactly
from noack.theory.margins.switched_system import Edge, SwitchedSystem

if TYPE_CHECKING:
    from scipy.sparse import csc_array  # slow to import

_MOST_ENTRIES = 16_000
"""Largest size of the operator's matrix, which is sparse: few states follow a state."""
_MOST_DENSE = 500
"""Size up to which all eigenvalues are computed."""
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

    Raises:
        NotPredictableError: an entry is infinite.
    """
    stack = np.array(maps)
    size = stack.shape[-1]
    if not np.isfinite(stack).all():
        raise NotPredictableError("the loop grows beyond 1e308 within a period")
    exponents = balancing_exponents(np.abs(stack).max(axis=(0, 1)))
    stack = np.ldexp(stack, exponents[:, None] - exponents)
    U, singular, _ = np.linalg.svd(stack.transpose(2, 0, 1, 3).reshape(size, -1))
    rank = max(int((singular > 10 * size * EPSILON * singular[0]).sum()), 1)
    stack = U[:, :rank].T @ stack @ U[:, :rank]
    edges = tuple(Edge(0, 0, exactly(matrix)) for slot in stack for matrix in slot)
    T = SwitchedSystem(edges).balancing()[0]
    stack = T @ stack @ np.linalg.inv(T)
    return [(delivered, lost) for delivered, lost in stack]


def bounded_radius(operator: "csc_array[np.float64]", size: int) -> float:
    """Return an upper bound of the spectral radius of an operator, mostly exact up to 2e-7.

    Args:
        operator: as :func:`second_moments` returns it.
        size: of each X_j.

    Raises:
        NotPredictableError: it cannot be computed.
    """
    from scipy.sparse import linalg  # slow to import

    if not np.isfinite(operator.data).all():
        raise NotPredictableError("the loop's second moments exceed 1e308 within a few periods")
    if operator.shape[0] <= _MOST_DENSE:
        radius = float(np.abs(np.linalg.eigvals(operator.toarray())).max())
    else:
        start = np.ones(operator.shape[0])
        try:
            radius = float(np.abs(linalg.eigs(operator, k=1, v0=start)[0]).max())
        except linalg.ArpackNoConvergence:
            raise NotPredictableError("the second moments' growth was not found") from None
    for above in _ABOVE:
        if radius == 0 or _is_below(operator, radius * (1 + above), size):
            return radius * (1 + 2 * above)
    raise NotPredictableError("the second moments could not be bounded numerically")


def second_moments(delivered: Matrix, lost: Matrix, outcomes: OutcomeChain) -> "csc_array[np.float64]":
    """Return the operator of one period on the stacked upper triangles of X_j.

    Raises:
        NotPredictableError: there are too many states.
    """
    from scipy import sparse  # slow to import

    size = len(delivered)
    if len(outcomes.lost) * size * (size + 1) // 2 > _MOST_ENTRIES:
        raise NotPredictableError("loop and losses together have too many states to compute with")
    losing = sparse.kron(sparse.csr_array(outcomes.lost.T), _on_triangle(lost))
    delivering = sparse.kron(sparse.csr_array(outcomes.delivered.T), _on_triangle(delivered))
    return (losing + delivering).tocsc()


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


def resolved_by(operator: "csc_array[np.float64]", value: float, entries: Vector) -> Vector:
    """Return the solution X of value · X − operator(X) = the entries."""
    from scipy.sparse import eye_array, linalg  # slow to import

    resolvent = (value * eye_array(operator.shape[0]) - operator).tocsc()
    return np.asarray(linalg.splu(resolvent).solve(entries), dtype=np.float64)


def _is_below(operator: "csc_array[np.float64]", bound: float, size: int) -> bool:
    """Return whether X_j > 0 with operator(X) < bound X prove that a bound is one, to rounding."""
    entries = operator.shape[0]
    identity = triangles(np.tile(np.eye(size), (2 * entries // (size * (size + 1)), 1, 1)))
    try:
        solution = resolved_by(operator, bound, identity)
    except RuntimeError:  # singular by rounding
        return False
    forms, images = (from_triangles(part, size) for part in (solution, np.asarray(operator @ solution)))
    longest = int(np.diff(operator.tocsr().indptr).max())
    sizes = np.abs(solution)
    carried = float((abs(operator) @ sizes + bound * sizes).max())
    return all(
        float(np.linalg.eigvalsh(part).min()) > 1e-13 * longest * size
        for part, size in ((forms, float(sizes.max())), (bound * forms - images, carried))
    )

"""Linear matrix inequalities: the largest value inside of all of them, by a barrier method.

Numbers and symmetric matrices F_i(z) are affine in a vector z. Of all z for which the numbers are
positive and the matrices positive definite, :meth:`MatrixInequalities.maximise_last` looks for one
whose last entry is large: Newton's method makes t z_last + Σ log det F_i(z) large, for larger and
larger t (Boyd and Vandenberghe, Convex Optimization, section 11.3; with m rows in all F_i, the
largest last entry exceeds the one at the maximum for t by at most m/t). It begins inside, and never
leaves. That its result is inside is checked with a margin for rounding.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector

_GAP = 0.02
"""Share of the last entry by which a larger one may exist."""
_HEAVIER, _MOST_NEWTON_STEPS = 8.0, 60
"""How t grows, and the most steps for one t."""
_CENTRED, _ARMIJO_SHARE, _SHORTEST_STEP = 0.05, 0.1, 1e-10
"""Newton's decrement (a square) where a t is done; the share of a step's promised increase that it
must have (Armijo's rule), and the shortest part of a step that is tried."""
_ROUNDING = 1e-13
"""Exceeds the relative rounding of an entry, a sum of hundreds of products."""
Blocks = tuple[Vector, *tuple[Matrix, ...]]
"""Numbers that are to be positive, and symmetric matrices that are to be positive definite."""


class MatrixInequalities:
    """Numbers and matrices that are affine in a vector, and are to be positive."""

    def __init__(self, blocks: Callable[[Vector], Blocks], size: int) -> None:
        self._constants = blocks(np.zeros(size))
        units = zip(*(blocks(unit) for unit in np.eye(size)), strict=True)
        self._slopes = [
            np.stack(parts, axis=-1) - c[..., None] for parts, c in zip(units, self._constants, strict=True)
        ]
        """The slope for each value, (k, size) and (n, n, size)."""
        self._triangles = [_triangle(len(matrix)) for matrix in self._constants[1:]]

    def _at(self, values: Vector) -> list[Matrix]:
        return [c + slopes @ values for c, slopes in zip(self._constants, self._slopes, strict=True)]

    def _hold(self, values: Vector) -> bool:
        """Whether all are positive by more than rounding."""
        sizes = (
            np.abs(c) + np.abs(slopes) @ np.abs(values)
            for c, slopes in zip(self._constants, self._slopes, strict=True)
        )
        return all(
            is_positive(block - _rounding(size)) for block, size in zip(self._at(values), sizes, strict=True)
        )

    def maximise_last(self, values: Vector) -> Vector | None:
        """Return values inside for which the last one is the largest, to a share of _GAP.

        t times the last value plus Σ log det is made large by Newton's method, for larger and larger t.
        The result is the last values that are inside by more than rounding; None if there are none.
        """
        dimension = sum(map(len, self._constants))
        weight, confirmed = 1.0, None
        while True:
            for _ in range(_MOST_NEWTON_STEPS):
                step, decrement = self._newton_step(values, weight)
                moved = self._step_along(values, step, weight, decrement) if decrement > _CENTRED else None
                if moved is None:
                    break
                values = moved
            if self._hold(values):
                confirmed = values
            if dimension < _GAP * weight * values[-1]:
                return confirmed
            weight *= _HEAVIER

    def _newton_step(self, values: Vector, weight: float) -> tuple[Vector, float]:
        """Return Newton's step and its decrement.

        The Hessian is AᵀA, with a column of A for each value: R of A's QR decomposition loses half of
        the digits that AᵀA would lose.
        """
        (numbers, *matrices), (of_numbers, *of_matrices) = self._at(values), self._slopes
        parts = [of_numbers / numbers[:, None]]
        gradient = parts[0].sum(axis=0)
        gradient[-1] += weight
        for matrix, slopes, (entries, weights) in zip(matrices, of_matrices, self._triangles, strict=True):
            inverse_root = np.linalg.inv(np.linalg.cholesky(matrix))
            transformed = inverse_root @ np.moveaxis(slopes, -1, 0) @ inverse_root.T
            gradient += np.trace(transformed, axis1=1, axis2=2)
            parts.append(transformed.reshape(len(values), -1)[:, entries].T * weights)
        A = np.vstack(parts)
        scales = 1 / np.linalg.norm(A, axis=0)
        R = np.asarray(np.linalg.qr(A * scales, mode="r"))
        step = scales * np.linalg.solve(R, np.linalg.solve(R.T, scales * gradient))
        return step, float(gradient @ step)

    def _step_along(self, values: Vector, step: Vector, weight: float, decrement: float) -> Vector | None:
        """Return the values after a step along which the objective grows, shortened if need be."""
        length, now = 1.0, self._objective(values, weight)
        while length > _SHORTEST_STEP:
            moved = values + length * step
            if self._objective(moved, weight) >= now + _ARMIJO_SHARE * length * decrement:
                return np.asarray(moved)
            length /= 2
        return None

    def _objective(self, values: Vector, weight: float) -> float:
        """Return t times the last value plus Σ log det; −∞ outside."""
        numbers, *matrices = self._at(values)
        if not (numbers > 0).all():
            return -np.inf
        try:
            roots = [np.linalg.cholesky(matrix) for matrix in matrices]
        except np.linalg.LinAlgError:
            return -np.inf
        logarithms = np.log(numbers).sum() + 2 * sum(np.log(np.diagonal(root)).sum() for root in roots)
        return float(weight * values[-1] + logarithms)


def _triangle(n: int) -> tuple[NDArray[np.intp], Matrix]:
    """Return the lower triangle's places in a flat matrix, (k,), and its weights w, (k, 1).

    The Frobenius norm of a symmetric matrix is that of its entries there times w.
    """
    rows, columns = np.tril_indices(n)
    return rows * n + columns, np.where(rows > columns, np.sqrt(2), 1.0)[:, None]


def is_positive(block: Matrix) -> bool:
    """Whether numbers are positive, or a symmetric matrix is positive definite."""
    if block.ndim == 1:
        return bool((block > 0).all())
    try:
        np.linalg.cholesky(block)
    except np.linalg.LinAlgError:
        return False
    return True


def _rounding(sizes: Matrix) -> Matrix:
    """Bound rounding by a share of these sizes: what is above it is positive whatever the rounding.

    A matrix whose entries are at most as large as those of ε S is at most the diagonal one with
    ε Σ_j S_ij √(S_jj/S_ii).
    """
    if sizes.ndim == 1:
        return _ROUNDING * sizes
    scales = np.sqrt(np.diagonal(sizes))
    return np.diag(_ROUNDING * sizes @ scales / scales)

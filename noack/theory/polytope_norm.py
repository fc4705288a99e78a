"""The norm whose unit ball is a symmetric polytope, of many points at once, by the simplex method.

‖y‖ = min Σ|c_i| over all y = Σ c_i v_i, v_i the vertices. Each basis of n vertices gives an upper
bound of ‖y‖, and an exchange of one vertex improves it. Every basis is thus a proof; how it was
found does not matter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.theory.interval_matrix import IntervalMatrix, exactly

_EXCHANGES = 400
_IMPROVEMENT = 1e-11
_PIVOT = 1e-9
_PRODUCTS = 250_000
"""Of a product of matrices: the BLAS uses several threads for larger ones, which is slower here."""
_NONE = -1
_ENLARGED = 1 + 2.0**-40


class Combinations(NamedTuple):
    """Points as combinations of n vertices each."""

    vertices: NDArray[np.int64]
    """(k, n), numbers of vertices."""
    coefficients: Matrix
    """(k, n)."""

    @property
    def norms(self) -> Vector:
        """Upper bounds of the norms, up to rounding, (k,)."""
        return np.asarray(np.abs(self.coefficients).sum(axis=1))


class PolytopeNorm:
    """The norm of a polytope with the vertices ±v_i.

    Args:
        vertices: (m, n); the first n are multiples s_i of the unit vectors.
    """

    def __init__(self, vertices: Matrix) -> None:
        self.vertices = vertices

    @property
    def _units(self) -> Vector:
        n = self.vertices.shape[1]
        return np.abs(np.diag(self.vertices[:n]))

    def combinations(self, points: Matrix, enough: float = 0.0) -> Combinations:
        """Return combinations for points, (k, n), of the smallest norm, or at most ``enough``."""
        none = np.full(len(points), _NONE)
        return self._in_chunks(points, enough, none)

    def redundant(self, first: int, enough: float) -> NDArray[np.bool_]:
        """Return which vertices from number ``first`` on have a norm up to ``enough`` without them.

        Each is compared with all others; the unit vectors are never redundant.
        """
        numbers = np.arange(first, len(self.vertices))
        norms = self._in_chunks(self.vertices[first:], enough, numbers).norms
        found = np.zeros(len(self.vertices), dtype=bool)
        found[first:] = (norms <= enough) & (numbers >= self.vertices.shape[1])
        return found

    def _in_chunks(self, points: Matrix, enough: float, without: NDArray[np.int64]) -> Combinations:
        chunk = max(_PRODUCTS // self.vertices.size, 16)
        parts = [
            self._combinations(points[i : i + chunk], enough, without[i : i + chunk])
            for i in range(0, len(points), chunk)
        ]
        return Combinations(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _combinations(
        self, points: Matrix, enough: float, without: NDArray[np.int64]
    ) -> Combinations:
        (k, n), V = points.shape, self.vertices
        chosen = np.tile(np.arange(n), (k, 1))
        signs = np.where(points >= 0, 1.0, -1.0) * np.sign(np.diag(V[:n]))
        coefficients = np.abs(points) / self._units
        active = np.arange(k)
        for _ in range(_EXCHANGES):
            active = active[coefficients[active].sum(axis=1) > enough]
            if not len(active):
                break
            try:
                undone = np.linalg.inv(V[chosen[active]] * signs[active][:, :, None])
            except np.linalg.LinAlgError:  # by rounding
                break
            # The vertex that violates the dual's inequalities most enters the basis.
            scores = undone.sum(axis=2) @ V.T
            scores[without[active] != _NONE, without[active][without[active] != _NONE]] = 0.0
            entering = np.abs(scores).argmax(axis=1)
            value = scores[np.arange(len(active)), entering]
            sign = np.sign(value)
            rates = np.einsum("ki,kij->kj", V[entering] * sign[:, None], undone)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = np.where(rates > _PIVOT, coefficients[active] / rates, np.inf)
            # The vertex whose coefficient reaches 0 first leaves it.
            leaving = ratios.argmin(axis=1)
            step = ratios[np.arange(len(active)), leaving]
            go = (np.abs(value) > 1 + _IMPROVEMENT) & np.isfinite(step)
            active, step, leaving = active[go], step[go], leaving[go]
            coefficients[active] = np.maximum(coefficients[active] - step[:, None] * rates[go], 0)
            coefficients[active, leaving] = step
            chosen[active, leaving] = entering[go]
            signs[active, leaving] = sign[go]
        return Combinations(chosen, coefficients * signs)

    def bounds(self, points: IntervalMatrix, enough: float = 0.0) -> Vector:
        """Return rigorous upper bounds of the norms of points, (k, n).

        A bound that is at most ``enough`` is not improved further.
        Nothing is assumed about the combinations; what they miss is a combination of unit vectors.
        """
        found = self.combinations(points.middle, enough)
        basis = exactly(self.vertices[found.vertices])
        sums = exactly(found.coefficients[:, None, :]) @ basis
        missed = (points - IntervalMatrix(sums.middle[:, 0], sums.radius[:, 0])).magnitude
        bounds = (found.norms + (missed / self._units).sum(axis=1)) * _ENLARGED
        return np.where(np.isnan(bounds), np.inf, bounds)

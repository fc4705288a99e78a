"""Upper bounds of the joint spectral radius by polytopes, one per node of a switched system.

If every edge takes the polytope of its source, shrunk by γ^duration, into that of its target, no
path grows faster than γ. The polytopes are built as by Guglielmi and Protasov (2013): each begins
with a few vertices; images of vertices that are outside are added until none is left. For γ above
the joint spectral radius this ends. Whatever vertices result, the bound is then computed from them
anew with all rounding included, so it does not depend on how they were found.

The norm whose unit ball is a symmetric polytope is ‖y‖ = min Σ|c_i| over all y = Σ c_i v_i, v_i the
vertices. It is computed for many points at once by the simplex method. Each basis of n vertices
gives an upper bound of ‖y‖, and an exchange of one vertex improves it. Every basis is thus a proof.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.theory.margins.exact_matrices import ENLARGED, IntervalMatrix, exactly
from noack.theory.margins.switched_system import Cycle, SwitchedSystem

_MOST_EXCHANGES = 400
"""Limit of the exchanges of the simplex method; a basis before the optimal one bounds the norm, too."""
_IMPROVEMENT, _PIVOT = 1e-11, 1e-9
"""Smaller violations of the dual's inequalities, and smaller entries of a column, are rounding."""
_MOST_MULTIPLICATIONS = 250_000
"""Multiplications in a product of matrices: for more, the BLAS uses several threads, which is slower here."""
_FIRST_LENGTH = 0.1
"""Length of the first vertices along the axes: they are there only to span the space."""
_LARGEST_INSIDE_NORM = 1 - 1e-9
"""Norm up to which an image is inside, although it is rounded."""
_MOST_ROUNDS, _WORK_PER_VERTEX = 60, 1_000_000
"""Limits: rounds in which images are added; entries that are compared, for each vertex that is allowed."""
_LARGEST_ENTRY = 1e3
"""Limit of the entries of a vertex: those of the first ones are at most 1, products are rarely this large."""


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
        self.work = 0
        """Number of entries of vertices that were compared."""

    @property
    def _units(self) -> Vector:
        n = self.vertices.shape[1]
        return np.abs(np.diag(self.vertices[:n]))

    def combinations(self, points: Matrix, enough: float = 0.0) -> Combinations:
        """Return combinations for points, (k, n), of the smallest norm, or at most ``enough``."""
        chunk = max(_MOST_MULTIPLICATIONS // self.vertices.size, 16)
        parts = [self._combinations(points[i : i + chunk], enough) for i in range(0, len(points), chunk)]
        return Combinations(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _combinations(self, points: Matrix, enough: float) -> Combinations:
        (k, n), V = points.shape, self.vertices
        chosen = np.tile(np.arange(n), (k, 1))
        signs = np.where(points >= 0, 1.0, -1.0) * np.sign(np.diag(V[:n]))
        coefficients = np.abs(points) / self._units
        active = np.arange(k)
        for _ in range(_MOST_EXCHANGES):
            active = active[coefficients[active].sum(axis=1) > enough]
            if not len(active):
                break
            try:
                inverse_basis = np.linalg.inv(V[chosen[active]] * signs[active][:, :, None])
            except np.linalg.LinAlgError:  # by rounding
                break
            # The vertex that violates the dual's inequalities most enters the basis.
            scores = inverse_basis.sum(axis=2) @ V.T
            self.work += scores.size * n
            entering = np.abs(scores).argmax(axis=1)
            value = scores[np.arange(len(active)), entering]
            sign = np.sign(value)
            rates = np.einsum("ki,kij->kj", V[entering] * sign[:, None], inverse_basis)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = np.where(rates > _PIVOT, coefficients[active] / rates, np.inf)
            # The vertex whose coefficient reaches 0 first leaves it.
            leaving = ratios.argmin(axis=1)
            step = ratios[np.arange(len(active)), leaving]
            improves = (np.abs(value) > 1 + _IMPROVEMENT) & np.isfinite(step)
            active, step, leaving = active[improves], step[improves], leaving[improves]
            coefficients[active] = np.maximum(coefficients[active] - step[:, None] * rates[improves], 0)
            coefficients[active, leaving] = step
            chosen[active, leaving] = entering[improves]
            signs[active, leaving] = sign[improves]
        return Combinations(chosen, coefficients * signs)

    def bounds(self, points: IntervalMatrix, enough: float = 0.0) -> Vector:
        """Return rigorous upper bounds of the norms of points, (k, n).

        A bound that is at most ``enough`` is not improved further.
        Nothing is assumed about the combinations; their residual is a combination of unit vectors.
        """
        combinations = self.combinations(points.middle, enough)
        basis = exactly(self.vertices[combinations.vertices])
        sums = exactly(combinations.coefficients[:, None, :]) @ basis
        residual = (points - IntervalMatrix(*(part[:, 0] for part in sums))).magnitude
        bounds = (combinations.norms + (residual / self._units).sum(axis=1)) * ENLARGED
        return np.where(np.isnan(bounds), np.inf, bounds)


def initial_vertices(system: SwitchedSystem, cycle: Cycle, growth: float) -> list[Matrix]:
    """Return short vectors along the axes, and the leading eigenvectors of a cycle, at each node."""
    vertices = [_FIRST_LENGTH * np.eye(system.dimension) for _ in range(system.graph.nodes)]
    if cycle.path:
        values, vectors = np.linalg.eig(system.product(cycle.path).middle)
        leading = vectors[:, int(np.abs(values).argmax())]
        rows = np.array([leading.real, leading.imag])
        rows = rows[np.linalg.norm(rows, axis=1) > 1e-9]
        for number in cycle.path:
            source = system.graph.sources[number]
            vertices[source] = np.concatenate([vertices[source], rows])
            rows = rows @ system.matrices.middle[number].T / growth ** system.graph.durations[number]
    return vertices


@dataclass
class InvariantPolytopes:
    """Polytopes of a system for a growth γ per unit of time."""

    system: SwitchedSystem
    growth: float
    vertices: list[Matrix]
    """The vertices of each node, (m, n)."""
    _work: int = 0

    @property
    def count(self) -> int:
        """Number of vertices."""
        return sum(map(len, self.vertices))

    def grow(self, most_vertices: int) -> bool:
        """Add images until all are inside.

        Return False when ``most_vertices`` vertices have been added, or after the work that they
        should cost, or when the vertices show that a path grows faster than γ, or after 60 rounds.
        """
        most_work = (most_vertices + self.count) * _WORK_PER_VERTEX
        pending, most_vertices = dict(enumerate(self.vertices)), self.count + most_vertices
        graph = self.system.graph
        steps = self.system.matrices.middle / (self.growth**graph.durations)[:, None, None]
        for _ in range(_MOST_ROUNDS):
            images: dict[int, list[Matrix]] = {}
            for source, target, step in zip(graph.sources, graph.targets, steps, strict=True):
                if source in pending:
                    images.setdefault(target, []).append(pending[source] @ step.T)
            pending = {}
            for node, parts in images.items():
                added = self._add(node, np.concatenate(parts))
                if len(added):
                    pending[node] = added
            if not pending:
                return True
            largest = max(float(np.abs(points).max()) for points in pending.values())
            if self.count > most_vertices or self._work > most_work or not largest < _LARGEST_ENTRY:
                break
        return False

    def _add(self, node: int, points: Matrix) -> Matrix:
        """Add the points that are outside, the farthest first; return them."""
        before = len(self.vertices[node])
        while len(points):
            norm = PolytopeNorm(self.vertices[node])
            norms = norm.combinations(points, enough=_LARGEST_INSIDE_NORM).norms
            self._work += norm.work
            order = np.argsort(-norms)
            order = order[norms[order] > _LARGEST_INSIDE_NORM]
            largest, points = np.split(points[order], [max(4, len(order) // 4)])
            self.vertices[node] = np.concatenate([self.vertices[node], largest])
        return self.vertices[node][before:]

    def bound(self) -> float:
        """Return a rigorous upper bound of the joint spectral radius, from the polytopes."""
        graph, growths = self.system.graph, [0.0]
        for source, target, duration, middle, radius in zip(
            graph.sources, graph.targets, graph.durations, *self.system.matrices, strict=True
        ):
            images = exactly(self.vertices[source]) @ IntervalMatrix(middle, radius).transposed
            norm, inside = PolytopeNorm(self.vertices[target]), self.growth**duration
            largest = float(norm.bounds(images, inside).max())
            growths.append(largest ** (1 / duration) * (1 + 1e-15))
        return max(growths)

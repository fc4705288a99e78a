"""Upper bounds of the joint spectral radius by polytopes, one per node of a switched system.

If every edge takes the polytope of its source, shrunk by γ^duration, into that of its target, no
path grows faster than γ. The polytopes are built as by Guglielmi and Protasov (2013): each begins
with a few vertices; images of vertices that are outside are added until none is left. For γ above
the joint spectral radius this ends. Whatever vertices result, the bound is then computed from them
anew with all rounding included, so it does not depend on how they were found.
"""

from dataclasses import dataclass, field

import numpy as np

from noack.core.linear_systems import Matrix
from noack.theory.destabilising_cycle import Cycle
from noack.theory.interval_matrix import IntervalMatrix, exactly
from noack.theory.polytope_norm import PolytopeNorm
from noack.theory.switched_system import SwitchedSystem

UNIT = 0.1
_INSIDE = 1 - 1e-9
_MUCH_LARGER = 1.3
_ROUNDS = 60
_FARTHEST = 1e3
"""Entries of a vertex, whose first ones have at most 1; products are rarely that much larger."""


def initial_vertices(system: SwitchedSystem, cycle: Cycle, growth: float) -> dict[int, Matrix]:
    """Return small unit vectors, and the leading eigenvectors of a cycle, at each node."""
    found = {node: [UNIT * np.eye(n)] for node, n in system.dimensions.items()}
    if cycle.path:
        values, vectors = np.linalg.eig(system.product(cycle.path).middle)
        leading = vectors[:, int(np.abs(values).argmax())]
        rows = np.array([leading.real, leading.imag])
        rows = rows[np.linalg.norm(rows, axis=1) > 1e-9]
        for number in cycle.path:
            edge = system.edges[number]
            found[edge.source].append(rows)
            rows = rows @ edge.matrix.middle.T / growth**edge.duration
    return {node: np.concatenate(parts) for node, parts in found.items()}


@dataclass
class InvariantPolytopes:
    """Polytopes of a system for a growth γ per unit of time."""

    system: SwitchedSystem
    growth: float
    vertices: dict[int, Matrix]
    """By node, (m, n)."""
    _examined: dict[int, int] = field(default_factory=dict)
    """Number of vertices after the last search for redundant ones, by node."""

    @property
    def count(self) -> int:
        """Number of vertices."""
        return sum(map(len, self.vertices.values()))

    def grow(self, most_vertices: int) -> bool:
        """Add images until all are inside.

        Return False at ``most_vertices`` vertices, or when the vertices show that a path grows
        faster than γ, or after 60 rounds.
        """
        pending = dict(self.vertices)
        for _ in range(_ROUNDS):
            images: dict[int, list[Matrix]] = {}
            for edge in self.system.edges:
                if edge.source in pending:
                    image = pending[edge.source] @ edge.matrix.middle.T
                    images.setdefault(edge.target, []).append(image / self.growth**edge.duration)
            pending = {}
            for node, parts in images.items():
                added = self._add(node, np.concatenate(parts))
                if len(added):
                    pending[node] = added
            if not pending:
                return True
            farthest = max(float(np.abs(points).max()) for points in pending.values())
            if self.count > most_vertices or not farthest < _FARTHEST:
                break
        return False

    def _add(self, node: int, points: Matrix) -> Matrix:
        """Add the points that are outside, the farthest first; return those that are vertices."""
        before = len(self.vertices[node])
        while len(points):
            norm = PolytopeNorm(self.vertices[node])
            norms = norm.combinations(points, enough=_INSIDE).norms
            order = np.argsort(-norms)
            order = order[norms[order] > _INSIDE]
            first, points = np.split(points[order], [max(4, len(order) // 4)])
            self.vertices[node] = np.concatenate([self.vertices[node], first])
        if len(self.vertices[node]) == before:
            return points
        # Without points in its interior it is the same polytope.
        everywhere = len(self.vertices[node]) > _MUCH_LARGER * self._examined.get(node, 0)
        kept = ~PolytopeNorm(self.vertices[node]).redundant(0 if everywhere else before, _INSIDE)
        added = self.vertices[node][before:][kept[before:]]
        self.vertices[node] = self.vertices[node][kept]
        if everywhere:
            self._examined[node] = len(self.vertices[node])
        return added

    def bound(self) -> float:
        """Return a rigorous upper bound of the joint spectral radius, from the polytopes."""
        growths = [0.0]
        for edge in self.system.edges:
            M = edge.matrix
            images = exactly(self.vertices[edge.source]) @ IntervalMatrix(M.middle.T, M.radius.T)
            norm, inside = PolytopeNorm(self.vertices[edge.target]), self.growth**edge.duration
            largest = float(norm.bounds(images, inside).max())
            growths.append(largest ** (1 / edge.duration) * (1 + 1e-15))
        return max(growths)

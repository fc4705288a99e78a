"""A linear system that switches along the edges of a graph, and the coordinates to study it in."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix
from noack.theory.interval_matrix import IntervalMatrix, exactly, inverse

_ITERATIONS = 60
_ROUNDEST = 1e-6
"""Smallest eigenvalue of a quadratic form, relative to the largest one."""


class Edge(NamedTuple):
    """A step of the system from one node to another: x becomes M x."""

    source: int
    target: int
    matrix: IntervalMatrix
    """M; its shape is given by the dimensions of the nodes."""
    duration: int = 1
    """Length of the step in units of time, at least 1; growth is counted per unit."""


@dataclass(frozen=True)
class SwitchedSystem:
    """Every path in a graph is a sequence of steps that may happen."""

    edges: tuple[Edge, ...]
    """Each node is left and reached by an edge, and every node can be reached from any other."""

    @property
    def dimensions(self) -> dict[int, int]:
        """Number of states, by node."""
        return {edge.source: edge.matrix.middle.shape[1] for edge in self.edges}

    def product(self, path: Sequence[int]) -> IntervalMatrix:
        """Enclose the product of the matrices of edges, given by number in their order of time."""
        first, *others = (self.edges[number].matrix for number in path)
        for matrix in others:
            first = matrix @ first
        return first

    def duration(self, path: Sequence[int]) -> int:
        """Return the length of a path in units of time."""
        return sum(self.edges[number].duration for number in path)

    def in_coordinates(self, forms: dict[int, Matrix]) -> "SwitchedSystem | None":
        """Return the system in the coordinates T x, with an invertible T for each node.

        None: an inverse could not be enclosed.
        """
        inverses = {node: inverse(form) for node, form in forms.items()}
        edges = []
        for edge in self.edges:
            undone = inverses[edge.source]
            if undone is None:
                return None
            matrix = exactly(forms[edge.target]) @ edge.matrix @ undone
            edges.append(edge._replace(matrix=matrix))
        return SwitchedSystem(tuple(edges))

    def balanced(self) -> "SwitchedSystem":
        """Return the system in the coordinates of :meth:`balancing`, or else itself."""
        return self.in_coordinates(self.balancing()) or self

    def balancing(self) -> dict[int, Matrix]:
        """Return T for each node; in T x no direction grows much more than others.

        The squared length in these coordinates is the fixed point of P ← Σ Mᵀ P M / c over the
        edges that leave a node, found by iteration. If that fails, T is the identity.
        """
        identity = {node: np.eye(n) for node, n in self.dimensions.items()}
        forms = identity
        for _ in range(_ITERATIONS):
            following = {node: np.zeros_like(form) for node, form in forms.items()}
            for edge in self.edges:
                M = edge.matrix.middle
                following[edge.source] += M.T @ forms[edge.target] @ M
            size = max(float(np.trace(form)) for form in following.values())
            if not 0 < size < np.inf:
                return identity
            forms = {
                node: form / size + _ROUNDEST * float(np.trace(form)) / size * np.eye(len(form))
                for node, form in following.items()
            }
        try:
            return {
                node: np.asarray(np.linalg.cholesky(form).T, dtype=np.float64)
                for node, form in forms.items()
            }
        except np.linalg.LinAlgError:
            return identity


def strongly_connected(edges: Sequence[Edge]) -> list[SwitchedSystem]:
    """Return the parts of a graph in which every node can be reached from any other.

    The growth of all infinite paths is that of those within one part.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    sources, targets = [edge.source for edge in edges], [edge.target for edge in edges]
    size = 1 + max(*sources, *targets)
    graph = coo_array((np.ones(len(edges)), (sources, targets)), shape=(size, size))
    _, labels = connected_components(graph, connection="strong")
    parts: dict[int, list[Edge]] = {}
    for edge in edges:
        if labels[edge.source] == labels[edge.target]:
            parts.setdefault(int(labels[edge.source]), []).append(edge)
    return [SwitchedSystem(tuple(part)) for part in parts.values()]

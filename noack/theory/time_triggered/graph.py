"""Paths in a graph whose edges have matrices: coordinates for them, and the cycle that grows most.

The search for a cycle keeps, of all paths of k edges, those with the largest products relative to the
growth so far. It is a heuristic in floating point.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Stack, Vector

Numbers = NDArray[np.int64]
"""Numbers of nodes or of edges, or durations, (k,)."""
_ITERATIONS = 60
"""Rounds of the search for balanced coordinates, which need not be exact."""
_LEAST_EIGENVALUE = 1e-6
"""Smallest eigenvalue of a quadratic form, relative to the largest one."""
_TINY = float(np.finfo(np.float64).tiny)
"""Added to a norm whose logarithm is taken, and to a root that may underflow."""
_SLOWEST = -50.0
"""Paths of different durations are compared with the best growth if its logarithm is above this."""
_EQUAL = 1e-12
"""Logarithms of growths that differ by less are those of one cycle."""


@dataclass(frozen=True)
class Graph:
    """The steps of a system without their matrices: k edges between nodes, numbered from 0."""

    sources: Numbers
    """(k,). Each node is left by an edge."""
    targets: Numbers
    durations: Numbers

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return int(self.sources.max()) + 1

    @cached_property
    def leaving(self) -> list[Numbers]:
        """The edges that leave each node."""
        return [np.flatnonzero(self.sources == node) for node in range(self.nodes)]

    def at(self, numbers: Numbers) -> "Graph":
        """Return the graph of some edges, by which each node is still left."""
        return Graph(self.sources[numbers], self.targets[numbers], self.durations[numbers])

    def only_cycle(self) -> tuple[int, ...] | None:
        """Return the edges of the only cycle, in their order of time; None if there are more.

        Every node is left by an edge; if by one only, there is no choice.
        """
        if self.nodes < len(self.sources):
            return None
        path = [0]
        while self.targets[path[-1]] != self.sources[0]:
            path.append(int(self.leaving[self.targets[path[-1]]][0]))
        return tuple(path)

    def balancing(self, matrices: Stack, iterations: int = _ITERATIONS) -> Stack:
        """Return T for each node, (nodes, n, n); in T x no direction grows much more than others.

        The squared length in these coordinates is the fixed point of P ← Σ Mᵀ P M / c over the
        edges that leave a node, found by iteration. If that fails, T is the identity.
        """
        identity = np.tile(np.eye(matrices.shape[1]), (self.nodes, 1, 1))
        forms = identity
        for _ in range(iterations):
            following = np.zeros_like(forms)
            np.add.at(following, self.sources, matrices.swapaxes(1, 2) @ forms[self.targets] @ matrices)
            traces = np.trace(following, axis1=1, axis2=2)[:, None, None]
            size = float(traces.max())
            if not 0 < size < np.inf:
                return identity
            forms = (following + _LEAST_EIGENVALUE * traces * identity) / size
        try:
            return np.asarray(np.linalg.cholesky(forms).swapaxes(1, 2), np.float64)
        except np.linalg.LinAlgError:
            return identity

    def fastest_cycle(
        self, matrices: Stack, most_edges: int, beam: int, at_least: float = -math.inf
    ) -> tuple[float, tuple[int, ...]]:
        """Search for the cycle with the largest growth; return log growth and the edges.

        Of all paths of each length, those with the largest products are continued.

        Args:
            matrices: matrices of the edges, (k, n, n), best in balanced coordinates.
            most_edges: largest length.
            beam: number of paths that are continued.
            at_least: logarithm of a known growth; without a faster cycle there are no edges.
        """
        best, cycle = at_least, tuple[int, ...]()
        paths, products = np.arange(len(matrices))[:, None], matrices
        durations = self.durations.astype(np.float64)
        for _ in range(most_edges):
            norms = np.log(np.linalg.norm(products, axis=(1, 2)) + _TINY) / durations
            # A product cannot grow faster than its norm.
            is_closed = self.sources[paths[:, 0]] == self.targets[paths[:, -1]]
            closed = np.flatnonzero(is_closed & (norms > best))
            if len(closed):
                with np.errstate(divide="ignore"):
                    growths = np.log(spectral_radii(products[closed])) / durations[closed]
                fastest = float(growths.max())
                if fastest > best + _EQUAL:  # always take the same rotation of a cycle
                    rotations = paths[closed[growths > fastest - _EQUAL]]
                    best, cycle = fastest, tuple(min(rotations.tolist()))
            rank = durations * (norms - (best if best > _SLOWEST else 0.0))
            longest = np.argsort(-rank, kind="stable")[:beam]
            steps = [self.leaving[self.targets[paths[index, -1]]] for index in longest]
            continued, step = np.repeat(longest, list(map(len, steps))), np.concatenate(steps)
            paths = np.concatenate([paths[continued], step[:, None]], axis=1)
            products = matrices[step] @ products[continued]
            durations = durations[continued] + self.durations[step]
        return best, cycle


def spectral_radii(matrices: Stack) -> Vector:
    """Return the spectral radii of matrices, (k,)."""
    return np.asarray(np.abs(np.linalg.eigvals(matrices)).max(axis=-1))

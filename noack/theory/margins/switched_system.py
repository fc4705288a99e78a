"""A linear system that switches along the edges of a graph; its coordinates, and its cycles.

The growth of a cycle is a lower bound of the joint spectral radius, and its value if the graph has
no other cycle. The search keeps, of all paths of k edges, those with the largest products relative
to the bound so far; it is a heuristic. The bounds of a cycle found are rigorous: for every k,
|trace Π^k|/n ≤ ρ(Π)^k ≤ ‖Π^k‖, and by repeated squaring in enclosures k becomes so large that the
k-th roots hardly differ. In the coordinates of its eigenvectors squaring loses fewer digits, and Π
is nearly a normal matrix, whose eigenvalues move by no more than the difference.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Vector, balancing_exponents
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.margins.exact_matrices import IntervalMatrix, exactly, inverse

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
_SQUARINGS = 44
"""j up to which Π^(2^j) is used: the factor n^(1/2^j) of the lower bound is then 1 to 3e-13."""
_SUBTRACTED = 1 - 1e-15
"""Lower bounds are multiplied and upper ones divided by this, for the rounding of an operation."""


class Edge(NamedTuple):
    """A step of the system from one node to another: x becomes M x."""

    source: int
    target: int
    matrix: IntervalMatrix
    """M, (n, n)."""
    duration: int = 1
    """Length of the step in units of time, at least 1; growth is counted per unit."""


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

    def renumbered(self) -> "Graph":
        """Return the graph with the nodes that occur numbered anew."""
        ends = np.unique([self.sources, self.targets], return_inverse=True)[1]
        sources, targets = ends.reshape(2, -1)
        return Graph(sources, targets, self.durations)

    def strongly_connected(self) -> list[Numbers]:
        """Return the edges of the parts in which every node can be reached from any other.

        The growth of all infinite paths is that of those within one part.
        """
        from scipy.sparse import coo_array  # slow to import
        from scipy.sparse.csgraph import connected_components

        size = 1 + int(max(self.sources.max(), self.targets.max()))
        graph = coo_array((np.ones(len(self.sources)), (self.sources, self.targets)), shape=(size, size))
        labels = connected_components(graph, connection="strong")[1]
        within, label = labels[self.sources] == labels[self.targets], labels[self.sources]
        return [np.flatnonzero(within & (label == part)) for part in np.unique(label[within])]

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


@dataclass(frozen=True)
class SwitchedSystem:
    """Every path in a graph is a sequence of steps that may happen."""

    graph: Graph
    matrices: IntervalMatrix
    """The matrices of its edges, (k, n, n)."""

    @classmethod
    def of(cls, edges: Sequence[Edge]) -> "SwitchedSystem":
        """Return the system of some edges, which keep their order; nodes are numbered anew."""
        sources, targets, matrices, durations = zip(*edges, strict=True)
        graph = Graph(*map(np.array, (sources, targets, durations)))
        stack = IntervalMatrix(*(np.array(part) for part in zip(*matrices, strict=True)))
        return cls(graph.renumbered(), stack)

    @property
    def dimension(self) -> int:
        """Number of states."""
        return int(self.matrices.middle.shape[1])

    def at(self, numbers: Numbers) -> "SwitchedSystem":
        """Return the system of some edges, with the nodes that occur numbered anew."""
        return SwitchedSystem(self.graph.at(numbers).renumbered(), self.matrices.at(numbers))

    def product(self, path: Sequence[int]) -> IntervalMatrix:
        """Enclose the product of the matrices of edges, given by number in their order of time."""
        product, *matrices = map(IntervalMatrix, *(part[list(path)] for part in self.matrices))
        for matrix in matrices:
            product = matrix @ product
        return product

    def in_coordinates(self, forms: Stack) -> "SwitchedSystem | None":
        """Return the system in the coordinates T x, with an invertible T for each node.

        None: an inverse could not be enclosed.
        """
        if (inverse_forms := inverse(forms)) is None:
            return None
        sources, targets = self.graph.sources, self.graph.targets
        return replace(self, matrices=exactly(forms[targets]) @ self.matrices @ inverse_forms.at(sources))

    def in_similar_units(self) -> "SwitchedSystem":
        """Return the system with its states times powers of two, the same at every node.

        Otherwise inputs in other units than the states' could leave it undecided.
        """
        sizes = np.abs(self.matrices.middle).max(axis=0)
        if not np.isfinite(sizes).all():
            return self
        exponents = balancing_exponents(sizes)
        return replace(self, matrices=self.matrices.scaled(exponents[:, None] - exponents))

    def balanced(self) -> "SwitchedSystem":
        """Return the system in the coordinates of :meth:`Graph.balancing`, or else itself."""
        return self.in_coordinates(self.graph.balancing(self.matrices.middle)) or self


class Cycle(NamedTuple):
    """A closed path and a rigorous lower bound of its growth."""

    path: tuple[int, ...]
    """Numbers of its edges."""
    growth: float
    """At most ρ(Π)^(1/duration)."""


NO_CYCLE = Cycle((), 0.0)
"""No cycle was found, so that 0 is the lower bound."""


def spectral_radius_bounds(product: IntervalMatrix) -> tuple[float, float]:
    """Return a lower and an upper bound of the spectral radii of all matrices Π, (n, n).

    They are the k-th roots of |trace Π^k|/n and of ‖Π^k‖∞, for the best k = 2^j; or, if the
    eigenvectors are well-conditioned, those of :func:`_normal_bounds`.
    """
    bounds = [_power_bounds(product)]
    values, vectors = np.linalg.eig(product.middle)
    # A real basis in which a matrix is nearly block-diagonal.
    basis = np.ascontiguousarray(np.where(values.imag >= 0, vectors.real, vectors.imag))
    inverse_basis = inverse(basis)
    if inverse_basis is not None:
        with np.errstate(over="ignore", invalid="ignore"):  # the basis may be nearly singular
            transformed = inverse_basis @ product @ exactly(basis)
            bounds += [_power_bounds(transformed), _normal_bounds(transformed, values)]
    lower, upper = zip(*bounds, strict=True)
    return max(lower), min(upper)


def _normal_bounds(matrices: IntervalMatrix, values: NDArray[np.complex128]) -> tuple[float, float]:
    """Bound the spectral radii of matrices near the normal one with blocks (a, −b; b, a).

    If they differ from it by at most r, their eigenvalues are in the discs of radius r around its
    n eigenvalues a ± ib, and each connected part of the discs contains one at least (Bauer and
    Fike, 1960; by continuity). Such a part is at most 2rn wide.
    """
    normal = np.diag(values.real)
    first = np.flatnonzero(values.imag > 0)  # its conjugate follows
    normal[first, first + 1], normal[first + 1, first] = -values.imag[first], values.imag[first]
    r = float(np.linalg.norm((matrices - exactly(normal)).magnitude)) * (1 + 1e-12)
    largest = float(np.abs(values).max())
    if not r < math.inf:
        return 0.0, math.inf
    return max(largest * _SUBTRACTED - 2 * len(values) * r, 0.0), (largest + r) / _SUBTRACTED


def _power_bounds(power: IntervalMatrix) -> tuple[float, float]:
    lower, upper, exponent = 0.0, math.inf, 0.0
    n = len(power.middle)
    for j in range(_SQUARINGS):
        # Π^(2^j) is the enclosure times 2^exponent.
        trace = abs(math.fsum(np.diag(power.middle)))
        trace = trace * _SUBTRACTED - math.fsum(np.diag(power.radius)) / _SUBTRACTED
        norm = float(power.magnitude.sum(axis=1).max())
        if trace > 0:
            lower = max(lower, _root(trace / n, exponent, j, -1))
        if norm < math.inf:
            upper = min(upper, _root(norm, exponent, j, 1) + _TINY)
        largest = float(np.abs(power.middle).max())
        if not float(power.radius.max()) < largest < math.inf:
            break
        shift = -math.frexp(largest)[1]
        power = power.scaled(shift)
        exponent = 2 * (exponent - shift)
        power = power @ power
    return lower, upper


def _root(value: float, exponent: float, j: int, sign: int) -> float:
    """Bound the 2^j-th root of value · 2^exponent from below (sign −1) or above (sign 1)."""
    # The logarithms are accurate to 1e-15 of their sizes.
    logarithm = (math.log2(value) + exponent) / 2**j
    slack = 1e-15 * (4 + abs(exponent / 2**j) + abs(logarithm))
    return float(2.0 ** (logarithm + sign * slack) * (1 + sign * 4e-16))


def find_cycle(system: SwitchedSystem, most_edges: int, beam: int) -> Cycle:
    """Search for the cycle with the largest growth, as :meth:`Graph.fastest_cycle`, and bound it."""
    _, path = system.graph.fastest_cycle(system.matrices.middle, most_edges, beam)
    return Cycle(path, growth_bounds(system, path)[0]) if path else NO_CYCLE


def growth_bounds(system: SwitchedSystem, path: Sequence[int]) -> tuple[float, float]:
    """Return a lower and an upper bound of the growth of a cycle per unit of time."""
    lower, upper = spectral_radius_bounds(system.product(path))
    share = 1 / int(system.graph.durations[list(path)].sum())
    return lower**share * (1 - 1e-15), upper**share * (1 + 1e-15)

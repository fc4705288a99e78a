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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, balancing_exponents
from noack.theory.margins.exact_matrices import IntervalMatrix, exactly, inverse

_ITERATIONS = 60
_ROUNDEST = 1e-6
"""Smallest eigenvalue of a quadratic form, relative to the largest one."""
_TINY = float(np.finfo(np.float64).tiny)
_SQUARINGS = 44
_SUBTRACTED = 1 - 1e-15


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
        product, *matrices = (self.edges[number].matrix for number in path)
        for matrix in matrices:
            product = matrix @ product
        return product

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

    def in_similar_units(self) -> "SwitchedSystem":
        """Return the system with its states times powers of two, the same at every node.

        Otherwise inputs in other units than the states' could leave it undecided.
        """
        if len(set(self.dimensions.values())) > 1:
            return self
        sizes = np.max([np.abs(edge.matrix.middle) for edge in self.edges], axis=0)
        if not np.isfinite(sizes).all():
            return self
        exponents = balancing_exponents(sizes)
        shifts = exponents[:, None] - exponents
        return SwitchedSystem(tuple(edge._replace(matrix=edge.matrix.scaled(shifts)) for edge in self.edges))

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
                node: np.asarray(np.linalg.cholesky(form).T, dtype=np.float64) for node, form in forms.items()
            }
        except np.linalg.LinAlgError:
            return identity


def strongly_connected(edges: Sequence[Edge]) -> list[SwitchedSystem]:
    """Return the parts of a graph in which every node can be reached from any other.

    The growth of all infinite paths is that of those within one part.
    """
    from scipy.sparse import coo_array  # slow to import
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


class Cycle(NamedTuple):
    """A closed path and a rigorous lower bound of its growth."""

    path: tuple[int, ...]
    """Numbers of its edges."""
    growth: float
    """At most ρ(Π)^(1/duration)."""


NO_CYCLE = Cycle((), 0.0)


def spectral_radius_bounds(product: IntervalMatrix) -> tuple[float, float]:
    """Return a lower and an upper bound of the spectral radii of all matrices Π, (n, n).

    They are the k-th roots of |trace Π^k|/n and of ‖Π^k‖∞, for the best k = 2^j; or, if the
    eigenvectors are well-conditioned, those of :func:`_normal_bounds`.
    """
    bounds = [_power_bounds(product)]
    values, vectors = np.linalg.eig(product.middle)
    # A real basis in which a matrix is nearly block-diagonal.
    basis = np.ascontiguousarray(np.where(values.imag >= 0, vectors.real, vectors.imag))
    undone = inverse(basis)
    if undone is not None:
        with np.errstate(over="ignore", invalid="ignore"):  # the basis may be nearly singular
            turned = undone @ product @ exactly(basis)
            bounds += [_power_bounds(turned), _normal_bounds(turned, values)]
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


class _Path(NamedTuple):
    edges: tuple[int, ...]
    source: int
    target: int
    duration: int
    product: Matrix
    norm: float


def find_cycle(system: SwitchedSystem, most_edges: int, beam: int) -> Cycle:
    """Search for the cycle with the largest growth among those of up to ``most_edges`` edges.

    Args:
        system: the system, best in balanced coordinates.
        most_edges: largest length.
        beam: number of paths that are kept at each length.
    """
    best: tuple[int, ...] = ()
    growth = 0.0
    leaving: dict[int, list[_Path]] = {}
    for number, edge in enumerate(system.edges):
        M = edge.matrix.middle
        step = _Path((number,), edge.source, edge.target, edge.duration, M, _size(M))
        leaving.setdefault(edge.source, []).append(step)
    paths = [step for steps in leaving.values() for step in steps]
    for _ in range(most_edges):
        closed = [
            path
            for path in paths
            # A product cannot grow faster than its norm.
            if path.source == path.target and path.norm > (growth * (1 + 1e-12)) ** path.duration
        ]
        for path, radius in zip(closed, _radii([path.product for path in closed]), strict=True):
            path_growth = radius ** (1 / path.duration)
            if path_growth > growth * (1 + 1e-12):
                best, growth = path.edges, path_growth
        scale = growth or 1.0
        paths.sort(key=lambda path: path.norm / max(scale**path.duration, _TINY), reverse=True)
        paths = [_joined(path, step) for path in paths[:beam] for step in leaving[path.target]]
    if not best:
        return NO_CYCLE
    return Cycle(best, growth_bounds(system, best)[0])


def _radii(matrices: Sequence[Matrix]) -> list[float]:
    """Return the spectral radii of matrices; those of one size are computed together."""
    radii = np.zeros(len(matrices))
    for size in {len(matrix) for matrix in matrices}:
        which = [k for k, matrix in enumerate(matrices) if len(matrix) == size]
        values = np.linalg.eigvals(np.array([matrices[k] for k in which]))
        radii[which] = np.abs(values).max(axis=1)
    return radii.tolist()


def growth_bounds(system: SwitchedSystem, path: Sequence[int]) -> tuple[float, float]:
    """Return a lower and an upper bound of the growth of a cycle per unit of time."""
    lower, upper = spectral_radius_bounds(system.product(path))
    share = 1 / system.duration(path)
    return lower**share * (1 - 1e-15), upper**share * (1 + 1e-15)


def only_cycle(system: SwitchedSystem) -> tuple[int, ...] | None:
    """Return the edges of the only cycle of a graph, in their order of time; None if it has more.

    Every node is left by an edge; if by one only, there is no choice.
    """
    leaving = {edge.source: number for number, edge in enumerate(system.edges)}
    if len(leaving) < len(system.edges):
        return None
    path = [0]
    while system.edges[path[-1]].target != system.edges[0].source:
        path.append(leaving[system.edges[path[-1]].target])
    return tuple(path)


def _joined(path: _Path, step: _Path) -> _Path:
    product = step.product @ path.product
    duration = path.duration + step.duration
    return _Path(path.edges + step.edges, path.source, step.target, duration, product, _size(product))


def _size(matrix: Matrix) -> float:
    return math.sqrt(float(np.vdot(matrix, matrix)))

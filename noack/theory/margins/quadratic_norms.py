"""Quadratic norms, one per node of a switched system, that bound its joint spectral radius.

If ‖T_w M x‖ ≤ γ^d ‖T_v x‖ for every edge from v to w with the matrix M and the duration d, no path
grows faster than γ. The matrices T_v are chosen so that the largest γ is as small as possible; the
bound is then computed from them with all rounding, so it does not depend on the search. Many edges,
for which polytopes would need many vertices, cost little more here; but the bound may stay above
the joint spectral radius. Then products of several steps in these norms are shorter than γ^duration
(:mod:`noack.theory.margins.branch_and_bound`).
"""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector
from noack.theory.margins.exact_matrices import IntervalMatrix, exactly, inverse
from noack.theory.margins.switched_system import Edge, SwitchedSystem

_FASTEST, _STEADY = 8, 17
MOST_ENTRIES = 300
"""Largest number of entries of all T_v; for more, the search takes too long: they are all equal."""
_SHARPNESS = (10.0, 100.0, 1000.0, 10000.0)
_STEPS = 200
_FIRST_EDGES, _FURTHER_EDGES = 48, 24
_ATTEMPTS = 8
_SETTLED = 1e-4
_SMALLEST = 1e-300
_ENLARGED = 1 + 2.0**-40


class QuadraticNorms(NamedTuple):
    """The norms ‖T_v x‖ of all nodes, and what they prove."""

    forms: dict[int, Matrix]
    """T_v of every node, (n, n)."""
    growths: Vector
    """Upper bounds of ‖T_w M T_v^{−1}‖^{1/d} of every edge; rounding is included, (k,)."""

    @property
    def upper(self) -> float:
        """Upper bound of the joint spectral radius."""
        return float(self.growths.max())


def quadratic_norms(system: SwitchedSystem) -> QuadraticNorms:
    """Return the best norms found, beginning with the Euclidean one."""
    dimensions = system.dimensions
    if sum(n * (n + 1) // 2 for n in dimensions.values()) > MOST_ENTRIES:
        if len(dimensions) > 1 and len(set(dimensions.values())) == 1:
            common = tuple(edge._replace(source=0, target=0) for edge in system.edges)
            forms, growths = quadratic_norms(SwitchedSystem(common))
            return QuadraticNorms(dict.fromkeys(dimensions, forms[0]), growths)
        search = _Search(system)
        return QuadraticNorms(search.forms, search.bounds())
    search = _Search(system)
    best = QuadraticNorms(search.forms, search.bounds())
    numbers = np.unique(np.linspace(0, len(system.edges) - 1, _FIRST_EDGES).astype(np.int64))
    for _ in range(_ATTEMPTS):
        search.improve(numbers)
        growths = search.growths()
        if growths.max() <= growths[numbers].max() + _SETTLED:
            break
        numbers = np.union1d(numbers, np.argsort(-growths)[:_FURTHER_EDGES])
    return min(best, QuadraticNorms(search.forms, search.bounds()), key=lambda norms: norms.upper)


def remembering(system: SwitchedSystem, classes: int) -> SwitchedSystem:
    """Return the same system with nodes that also remember the class of the last edge.

    The classes have equal numbers of edges, in the order of the edges. More norms give a smaller
    bound (Ahmadi, Jungers, Parrilo and Roozbehani, *SIAM J. Control Optim.* 52, 2014). Each edge
    becomes ``classes`` successive ones.
    """
    ends: dict[int, list[int]] = {}
    for number, edge in enumerate(system.edges):
        ends.setdefault(edge.target, []).append(number)
    kinds = {
        number: index * classes // len(members)
        for members in ends.values()
        for index, number in enumerate(members)
    }
    return SwitchedSystem(tuple(
        Edge(edge.source * classes + kind, edge.target * classes + kinds[number], *edge[2:])
        for number, edge in enumerate(system.edges) for kind in range(classes)
    ))  # fmt: skip


def representatives(system: SwitchedSystem, growths: Vector) -> list[int]:
    """Return some edges that leave each node: those that grow most, and some of each duration."""
    leaving: dict[int, list[int]] = {}
    for number, edge in enumerate(system.edges):
        leaving.setdefault(edge.source, []).append(number)
    chosen: set[int] = set()
    for members in leaving.values():
        fastest = sorted(members, key=lambda number: -growths[number])[:_FASTEST]
        steady = sorted(members, key=lambda number: system.edges[number].duration)
        places = np.linspace(0, len(steady) - 1, min(_STEADY, len(steady)))
        chosen.update(fastest)
        chosen.update(steady[index] for index in places.round().astype(int).tolist())
    return sorted(chosen)


def norms_above(matrices: IntervalMatrix) -> Vector:
    """Return upper bounds of the Euclidean norms of all matrices of enclosures, (k, m, n) → (k,).

    With the computed eigenvectors V of MᵀM, ‖MᵀM‖ ≤ ‖VᵀMᵀMV‖ ‖V^{−1}‖². The first norm is at most
    the largest sum of a row, and ‖V^{−1}‖² ≤ 1/(1 − ‖I − VᵀV‖).
    """
    M, transposed = matrices, IntervalMatrix(*(part.swapaxes(1, 2) for part in matrices))
    V = exactly(np.linalg.eigh(transposed.middle @ M.middle)[1])
    turned = exactly(V.middle.swapaxes(1, 2))
    square = turned @ (transposed @ M) @ V
    defect = exactly(np.eye(M.middle.shape[2])) - turned @ V
    size, missed = (matrix.magnitude.sum(axis=2).max(axis=1) for matrix in (square, defect))
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.sqrt(size / (1 - missed)) * _ENLARGED
    return np.where(missed < 0.5, bounds, np.inf)


class _Steps(NamedTuple):
    """Edges between the same two nodes."""

    source: int
    target: int
    numbers: NDArray[np.int64]
    matrices: IntervalMatrix
    """(k, m, n)."""


class _Search:
    """Looks for T_v, lower triangular, that minimise the largest γ of all edges."""

    def __init__(self, system: SwitchedSystem) -> None:
        self._edges = system.edges
        self._nodes = {node: np.tril_indices(n) for node, n in system.dimensions.items()}
        self.forms: dict[int, Matrix] = {node: np.eye(n) for node, n in system.dimensions.items()}
        """T_v of every node."""
        self._durations = np.array([float(edge.duration) for edge in self._edges])
        self._shares = self._durations / self._durations.max()
        self._all = list(self._grouped(range(len(self._edges))))

    def growths(self) -> Vector:
        """Return the logarithm of γ per longest duration, of every edge, (k,)."""
        logarithms = np.zeros(len(self._edges))
        for steps in self._all:
            turned = self.forms[steps.target] @ steps.matrices.middle
            turned = turned @ _inverse(self.forms[steps.source])
            norms = np.linalg.norm(turned, 2, axis=(1, 2))
            logarithms[steps.numbers] = np.log(np.maximum(norms, _SMALLEST))
        return np.asarray(logarithms / self._shares)

    def bounds(self) -> Vector:
        """Return upper bounds of γ of every edge, with all rounding, (k,)."""
        bounds = np.full(len(self._edges), np.inf)
        for steps in self._all:
            undone = inverse(self.forms[steps.source])
            if undone is not None:
                turned = exactly(self.forms[steps.target]) @ steps.matrices @ undone
                roots = norms_above(turned) ** (1 / self._durations[steps.numbers])
                bounds[steps.numbers] = roots * (1 + 1e-15)
        return bounds

    def improve(self, numbers: NDArray[np.int64]) -> None:
        """Minimise the maximum over some edges: a smooth one that becomes sharper and sharper."""
        from scipy.optimize import minimize  # slow to import

        groups = list(self._grouped(numbers.tolist()))
        for sharpness in _SHARPNESS:
            entries = np.concatenate([self.forms[v][lower] for v, lower in self._nodes.items()])
            minimum = minimize(
                self._smooth_maximum, entries, (groups, sharpness), "L-BFGS-B", jac=True,
                options={"maxiter": _STEPS},
            )  # fmt: skip
            self.forms = self._matrices(minimum.x)

    def _grouped(self, numbers: Iterable[int]) -> Iterator[_Steps]:
        groups: dict[tuple[int, int], list[int]] = {}
        for number in numbers:
            edge = self._edges[number]
            groups.setdefault((edge.source, edge.target), []).append(number)
        for (source, target), members in groups.items():
            matrices = [self._edges[number].matrix for number in members]
            stack = IntervalMatrix(*(np.array(part) for part in zip(*matrices, strict=True)))
            yield _Steps(source, target, np.array(members), stack)

    def _matrices(self, entries: Vector) -> dict[int, Matrix]:
        matrices, begin = {}, 0
        for node, lower in self._nodes.items():
            size = len(lower[0])
            matrices[node] = np.zeros_like(self.forms[node])
            matrices[node][lower] = entries[begin : begin + size]
            begin += size
        return matrices

    def _smooth_maximum(
        self, entries: Vector, groups: list[_Steps], sharpness: float
    ) -> tuple[float, Vector]:
        """Return log(Σ e^{s g})/s of the logarithms g of γ, and its gradient.

        For σ = uᵀ T_w M T_v^{−1} v: dσ = uᵀ dT_w M T_v^{−1} v − σ vᵀ dT_v T_v^{−1} v.
        """
        forms = self._matrices(entries)
        try:
            undone = {node: _inverse(form) for node, form in forms.items()}
        except np.linalg.LinAlgError:
            return math.inf, np.zeros_like(entries)
        parts = []
        for steps in groups:
            turned = forms[steps.target] @ steps.matrices.middle @ undone[steps.source]
            U, sizes, Vt = np.linalg.svd(turned)
            sigma = np.maximum(sizes[:, 0], _SMALLEST)
            g = np.log(sigma) / self._shares[steps.numbers]
            right = Vt[:, 0] @ undone[steps.source].T  # T_v^{−1} v
            moved = np.einsum("kij,kj->ki", steps.matrices.middle, right) / sigma[:, None]
            parts.append((steps, g, U[:, :, 0], moved, Vt[:, 0], right))
        largest = max(float(g.max()) for _, g, *_ in parts)
        total = sum(float(np.exp(sharpness * (g - largest)).sum()) for _, g, *_ in parts)
        gradients = {node: np.zeros_like(form) for node, form in forms.items()}
        for steps, g, u, moved, v, right in parts:
            share = np.exp(sharpness * (g - largest)) / total / self._shares[steps.numbers]
            gradients[steps.target] += (share[:, None] * u).T @ moved
            gradients[steps.source] -= (share[:, None] * v).T @ right
        slope = np.concatenate([gradients[v][lower] for v, lower in self._nodes.items()])
        return largest + math.log(total) / sharpness, slope


def _inverse(matrix: Matrix) -> Matrix:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)

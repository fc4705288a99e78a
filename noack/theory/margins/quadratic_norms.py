"""Quadratic norms, one per node of a switched system, that bound its joint spectral radius.

If ‖T_w M x‖ ≤ γ^d ‖T_v x‖ for every edge from v to w with the matrix M and the duration d, no path
grows faster than γ. With P = TᵀT these are linear matrix inequalities, F = P_v − NᵀP_wN ≻ 0 with
N = M γ^−d. The smallest γ is approached from inside, as interior-point methods do: the sum
c log γ + Σ tr P_v − Σ log det F is made small by Newton's method, for larger and larger c.

The bound is computed from the norms with all rounding, so it does not depend on the search. It may
stay above the joint spectral radius. Then there are more norms if the nodes also remember the last
edges (:func:`remembering`), or products of several steps are shorter than γ^duration
(:func:`~noack.theory.margins.joint_spectral_radius.bound_by_products`).
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
FEW_ENTRIES, MOST_ENTRIES = 1200, 2500
"""Numbers of entries of all P_v with which the search takes some seconds, and up to a minute."""
_STAGES, _NEWTON_STEPS = 40, 40
_HEAVIER = 4.0
"""Factor of the weight of log γ from stage to stage."""
_FIRST = 0.3
"""Distance of the first log γ from the one that holds, per longest duration."""
_CLOSE = 2e-5
_DECREASE, _SHORTEST, _CENTERED = 0.1, 1e-6, 0.5
_FIRST_EDGES, _FURTHER_EDGES = 200, 50
_ATTEMPTS = 8
_SETTLED = 1e-4
_LARGEST_LOGARITHM = 300.0
_SMALLEST = 1e-300
_ENLARGED = 1 + 2.0**-40
_Stack = NDArray[np.float64]
"""Matrices of nodes or edges, (k, n, n)."""


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


class NormSearch:
    """Looks for norms with the smallest γ, beginning with the balanced coordinates.

    Args:
        system: the system.
        most_entries: largest number of entries of all P_v; for more, all P_v are equal.
    """

    def __init__(self, system: SwitchedSystem, most_entries: int = MOST_ENTRIES) -> None:
        dimensions = system.dimensions
        is_common = entries_of(system) > most_entries and len(set(dimensions.values())) == 1
        self._nodes = {node: number for number, node in enumerate(dimensions)}
        if is_common:
            self._nodes = dict.fromkeys(dimensions, 0)
        self._edges, self._dimensions = system.edges, dimensions
        if is_common:
            system = SwitchedSystem(tuple(edge._replace(source=0, target=0) for edge in system.edges))
        coordinates = system.balancing()
        balanced = system.in_coordinates(coordinates)
        if balanced is None:
            balanced, coordinates = system, {v: np.eye(n) for v, n in system.dimensions.items()}
        self._coordinates = {v: coordinates[0 if is_common else v] for v in dimensions}
        n = max(dimensions.values())
        self._matrices = np.zeros((len(self._edges), n, n))
        for padded, edge in zip(self._matrices, balanced.edges, strict=True):
            rows, columns = edge.matrix.middle.shape
            padded[:rows, :columns] = edge.matrix.middle
        self._sources = np.array([self._nodes[edge.source] for edge in self._edges])
        self._targets = np.array([self._nodes[edge.target] for edge in self._edges])
        self._durations = np.array([float(edge.duration) for edge in self._edges])
        count = max(self._nodes.values()) + 1
        self._squares: _Stack = np.tile(np.eye(n) * len(self._edges) / count, (count, 1, 1))
        """P_v in balanced coordinates; they are enlarged to the largest dimension."""

    def improve(self, target: float) -> QuadraticNorms:
        """Improve the norms until they prove a growth, or hardly become better."""
        goal, settled = math.log(max(target, _SMALLEST)), _SETTLED / self._durations.max()
        firsts = np.unique(self._sources, return_index=True)[1]
        spread = np.unique(np.linspace(0, len(self._edges) - 1, _FIRST_EDGES).astype(np.int64))
        numbers = np.union1d(firsts, spread)
        for _ in range(_ATTEMPTS):
            self._squares = _Centers(
                self._matrices[numbers],
                self._sources[numbers],
                self._targets[numbers],
                self._durations[numbers],
            ).approach(self._squares, goal)
            growths = self._growths()
            if growths.max() <= max(growths[numbers].max() + settled, goal):
                break
            numbers = np.union1d(numbers, np.argsort(-growths)[:_FURTHER_EDGES])
        forms = self._forms()
        return QuadraticNorms(forms, self._bounds(forms))

    def _growths(self) -> Vector:
        return _log_growths(self._squares, self._matrices, self._sources, self._targets, self._durations)

    def _forms(self) -> dict[int, Matrix]:
        return {
            node: np.linalg.cholesky(self._squares[self._nodes[node], :n, :n]).T @ self._coordinates[node]
            for node, n in self._dimensions.items()
        }

    def _bounds(self, forms: dict[int, Matrix]) -> Vector:
        """Return upper bounds of γ of every edge, with all rounding, (k,)."""
        bounds = np.full(len(self._edges), np.inf)
        for steps in _grouped(self._edges):
            undone = inverse(forms[steps.source])
            if undone is not None:
                turned = exactly(forms[steps.target]) @ steps.matrices @ undone
                roots = norms_above(turned) ** (1 / self._durations[steps.numbers])
                bounds[steps.numbers] = roots * (1 + 1e-15)
        return bounds


def entries_of(system: SwitchedSystem) -> int:
    """Return the number of entries of one norm for each node."""
    return sum(n * (n + 1) // 2 for n in system.dimensions.values())


class _Centers(NamedTuple):
    """The inequalities F ≻ 0 of some edges; nodes are numbered from 0."""

    matrices: _Stack
    sources: NDArray[np.int64]
    targets: NDArray[np.int64]
    durations: Vector

    def approach(self, P: _Stack, goal: float) -> _Stack:
        """Return P for a smaller log γ, at most ``goal`` if that is found."""
        longest, count = float(self.durations.max()), self.matrices[:, 0].size
        known = float(_log_growths(P, *self).max())
        level = known + _FIRST / longest
        weight = count * longest
        for _ in range(_STAGES):
            for _ in range(_NEWTON_STEPS):
                moved = self._moved(P, level, weight)
                if moved is None:
                    break
                P, level, decrement = moved
                if decrement < _CENTERED:
                    break
            known = min(float(_log_growths(P, *self).max()), level)
            if known < goal or count / weight < _CLOSE / longest:
                break
            weight *= _HEAVIER
        return P

    def _moved(self, P: _Stack, level: float, weight: float) -> tuple[_Stack, float, float] | None:
        """Return P and log γ after a step of Newton's method, and twice what it promised.

        None: no step along its direction makes the value smaller.
        """
        try:
            change, further, decrement = self._direction(P, level, weight)
        except (np.linalg.LinAlgError, RuntimeError):  # singular by rounding
            return None
        value, share = self._value(P, level, weight), 1.0
        while share > _SHORTEST:
            new = P + share * change, level + share * further
            if self._value(*new, weight) < value - _DECREASE * share * decrement:
                return *new, decrement
            share /= 2
        return None

    def _value(self, P: _Stack, level: float, weight: float) -> float:
        """Return weight · log γ + Σ tr P − Σ log det F; infinity outside."""
        if not -level * float(self.durations.max()) < _LARGEST_LOGARITHM:
            return math.inf
        try:
            steps = self._steps(level)
            roots = np.linalg.cholesky(P[self.sources] - self._carried(P, steps))
            np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            return math.inf
        diagonals = np.diagonal(roots, axis1=1, axis2=2)
        traces = np.trace(P, axis1=1, axis2=2)
        return float(weight * level + traces.sum() - 2 * np.log(diagonals).sum())

    def _steps(self, level: float) -> _Stack:
        """Return N of each edge."""
        return np.asarray(self.matrices * np.exp(-level * self.durations)[:, None, None])

    def _carried(self, P: _Stack, steps: _Stack) -> _Stack:
        """Return NᵀP_wN of each edge."""
        return np.asarray(steps.swapaxes(1, 2) @ P[self.targets] @ steps)

    def _direction(self, P: _Stack, level: float, weight: float) -> tuple[_Stack, float, float]:
        """Return Newton's change of P and of log γ, and twice the decrease that it promises.

        With G = F^{−1}, the curvature is tr(G dF G dF) with dF = dP_v − NᵀdP_wN + S dlog γ,
        S = 2d NᵀP_wN, and 2d tr(G S) for log γ; the rest would make it indefinite.
        """
        from scipy.sparse import coo_array  # slow to import
        from scipy.sparse.linalg import splu

        (count, n), steps = P.shape[:2], self._steps(level)
        basis = _symmetric_basis(n)
        size, carried = basis.shape[1], self._carried(P, steps)
        G = np.asarray(np.linalg.inv(P[self.sources] - carried), dtype=np.float64)
        S = 2 * self.durations[:, None, None] * carried
        mixed, turned = G @ steps.swapaxes(1, 2), G @ S

        def of_nodes(edges: _Stack, first: Matrix) -> Vector:
            """Return Σ tr(X dF) as a function of all P, for X of each edge, and tr(Y dP_v)."""
            total = np.tile(first, (count, 1, 1))
            np.add.at(total, self.sources, edges)
            np.add.at(total, self.targets, -steps @ edges @ steps.swapaxes(1, 2))
            return np.asarray((total.reshape(count, n * n) @ basis).ravel())

        def products(factors: _Stack) -> _Stack:
            squares = np.einsum("eij,ekl->eikjl", factors, factors)
            return np.asarray(basis.T @ squares.reshape(-1, n * n, n * n) @ basis)

        crossed = -products(mixed)
        blocks = np.concatenate([products(G), products(steps @ mixed), crossed, crossed.swapaxes(1, 2)])
        rows = np.concatenate([self.sources, self.targets, self.sources, self.targets]) * size
        columns = np.concatenate([self.sources, self.targets, self.targets, self.sources]) * size
        inner = np.arange(size)
        i = np.broadcast_to(rows[:, None, None] + inner[:, None], blocks.shape)
        j = np.broadcast_to(columns[:, None, None] + inner, blocks.shape)
        shape = (count * size, count * size)
        curvature = coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=shape).tocsc()
        solver = splu(curvature, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        slope, border = of_nodes(-G, np.eye(n)), of_nodes(turned @ G, np.zeros((n, n)))
        along, across = solver.solve(slope), solver.solve(border)
        sums = np.trace(turned, axis1=1, axis2=2)
        own_slope = weight - float(sums.sum())
        corner = float(np.einsum("eij,eji->", turned, turned) + 2 * self.durations @ sums)
        corner -= float(border @ across)
        if not corner > 0:
            raise np.linalg.LinAlgError
        further = -(own_slope - float(border @ along)) / corner
        change = -along - further * across
        decrement = -float(slope @ change) - own_slope * further
        return (change.reshape(count, size) @ basis.T).reshape(P.shape), further, decrement


def _symmetric_basis(n: int) -> Matrix:
    """Return the map from lower triangles to symmetric matrices, (n², n(n+1)/2)."""
    rows, columns = np.tril_indices(n)
    basis = np.zeros((n * n, len(rows)))
    for position in (rows * n + columns, columns * n + rows):
        basis[position, np.arange(len(rows))] = 1.0
    return basis


def _log_growths(
    P: _Stack, matrices: _Stack, sources: NDArray[np.int64], targets: NDArray[np.int64], durations: Vector
) -> Vector:
    """Return log γ of every edge, (k,)."""
    forms = np.linalg.cholesky(P).swapaxes(1, 2)
    turned = forms[targets] @ matrices @ np.linalg.inv(forms)[sources]
    norms = np.linalg.norm(turned, 2, axis=(1, 2))
    return np.asarray(np.log(np.maximum(norms, _SMALLEST)) / durations)


class _Steps(NamedTuple):
    """Edges between the same two nodes."""

    source: int
    target: int
    numbers: NDArray[np.int64]
    matrices: IntervalMatrix
    """(k, m, n)."""


def _grouped(edges: Iterable[Edge]) -> Iterator[_Steps]:
    groups: dict[tuple[int, int], list[tuple[int, Edge]]] = {}
    for number, edge in enumerate(edges):
        groups.setdefault((edge.source, edge.target), []).append((number, edge))
    for (source, target), members in groups.items():
        matrices = [edge.matrix for _, edge in members]
        stack = IntervalMatrix(*(np.array(part) for part in zip(*matrices, strict=True)))
        yield _Steps(source, target, np.array([number for number, _ in members]), stack)


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
    return SwitchedSystem(
        tuple(
            Edge(edge.source * classes + kind, edge.target * classes + kinds[number], *edge[2:])
            for number, edge in enumerate(system.edges)
            for kind in range(classes)
        )
    )


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
    return np.where((missed < 0.5) & ~np.isnan(bounds), bounds, np.inf)

"""Quadratic norms, one per node of a switched system, that bound its joint spectral radius.

If ‖T_w M x‖ ≤ γ^d ‖T_v x‖ for every edge from v to w with the matrix M and the duration d, no path
grows faster than γ. With P = TᵀT these are linear matrix inequalities, F = P_v − NᵀP_wN ≻ 0 with
N = M γ^−d. The smallest γ is approached by the method of centers (Boyd and El Ghaoui, 1993): the
minimum of Σ tr P_v − Σ log det F for some γ is found by Newton's method; it satisfies the
inequalities for a smaller γ, too, and the next γ is a little above that.

The bound is computed from the norms with all rounding, so it does not depend on the search. It may
stay above the joint spectral radius. Then there are more norms if the nodes also remember the last
edges (:func:`remembering`), or products of several steps are shorter than γ^duration
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
FEW_ENTRIES, MOST_ENTRIES = 1200, 2500
"""Numbers of entries of all P_v with which the search takes some seconds, and up to a minute."""
_CENTERS, _NEWTON_STEPS = 100, 6
_NEXT = 0.1
"""The next γ is above the one that holds by this share of the distance from the last one."""
_FIRST, _AGAIN = 0.3, 0.02
"""Distance of the first γ, as a logarithm per longest duration; later ones start near the end."""
_CLOSE = 2e-5
_DECREASE, _SHORTEST, _CENTERED = 0.1, 1e-6, 0.5
_FIRST_EDGES, _FURTHER_EDGES = 200, 50
_ATTEMPTS = 8
_SETTLED = 1e-4
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
        self._nodes = dict.fromkeys(dimensions, 0) if is_common else {
            node: number for number, node in enumerate(dimensions)
        }  # fmt: skip
        self._edges, self._dimensions = system.edges, dimensions
        if is_common:
            system = SwitchedSystem(
                tuple(edge._replace(source=0, target=0) for edge in system.edges)
            )
        coordinates = system.balancing()
        balanced = system.in_coordinates(coordinates)
        if balanced is None:
            balanced, coordinates = system, {v: np.eye(n) for v, n in system.dimensions.items()}
        self._coordinates = {v: coordinates[0 if is_common else v] for v in dimensions}
        n = max(dimensions.values())
        self._matrices = np.zeros((len(self._edges), n, n))
        for place, edge in zip(self._matrices, balanced.edges, strict=True):
            rows, columns = edge.matrix.middle.shape
            place[:rows, :columns] = edge.matrix.middle
        self._sources = np.array([self._nodes[edge.source] for edge in self._edges])
        self._targets = np.array([self._nodes[edge.target] for edge in self._edges])
        self._durations = np.array([float(edge.duration) for edge in self._edges])
        count = max(self._nodes.values()) + 1
        self._squares: _Stack = np.tile(np.eye(n) * len(self._edges) / count, (count, 1, 1))
        """P_v in balanced coordinates; they are enlarged to the largest dimension."""
        self._first = _FIRST

    def improve(self, wanted: float) -> QuadraticNorms:
        """Improve the norms until they prove a growth, or hardly become better."""
        goal, settled = math.log(max(wanted, _SMALLEST)), _SETTLED / self._durations.max()
        firsts = np.unique(self._sources, return_index=True)[1]
        spread = np.unique(np.linspace(0, len(self._edges) - 1, _FIRST_EDGES).astype(np.int64))
        numbers = np.union1d(firsts, spread)
        for _ in range(_ATTEMPTS):
            self._squares = _Centers(
                self._matrices[numbers], self._sources[numbers], self._targets[numbers],
                self._durations[numbers],
            ).approach(self._squares, goal, self._first)  # fmt: skip
            self._first = _AGAIN
            growths = self._growths()
            if growths.max() <= max(growths[numbers].max() + settled, goal):
                break
            numbers = np.union1d(numbers, np.argsort(-growths)[:_FURTHER_EDGES])
        forms = self._forms()
        return QuadraticNorms(forms, self._bounds(forms))

    def _growths(self) -> Vector:
        return _log_growths(
            self._squares, self._matrices, self._sources, self._targets, self._durations
        )

    def _forms(self) -> dict[int, Matrix]:
        return {
            node: np.linalg.cholesky(self._squares[self._nodes[node], :n, :n]).T
            @ self._coordinates[node]
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

    def approach(self, P: _Stack, goal: float, first: float) -> _Stack:
        """Return P for a smaller log γ, at most ``goal`` if that is found."""
        known = float(_log_growths(P, *self).max())
        level = known + first / float(self.durations.max())
        for _ in range(_CENTERS):
            if known < goal or level - known < _CLOSE / self.durations.max():
                break
            level = known + _NEXT * (level - known)
            steps = self.matrices * np.exp(-level * self.durations)[:, None, None]
            P = self._center(P, steps)
            known = min(float(_log_growths(P, *self).max()), level)
        return P

    def _center(self, P: _Stack, steps: _Stack) -> _Stack:
        value = self._value(P, steps)
        for _ in range(_NEWTON_STEPS):
            try:
                change, decrement = self._newton_step(P, steps)
            except (np.linalg.LinAlgError, RuntimeError):  # singular by rounding
                break
            share = 1.0
            while share > _SHORTEST:
                tried = self._value(P + share * change, steps)
                if tried < value - _DECREASE * share * decrement:
                    break
                share /= 2
            else:
                break
            P, value = P + share * change, tried
            if decrement < _CENTERED:
                break
        return P

    def _slacks(self, P: _Stack, steps: _Stack) -> _Stack:
        """Return F of each edge."""
        return P[self.sources] - steps.swapaxes(1, 2) @ P[self.targets] @ steps

    def _value(self, P: _Stack, steps: _Stack) -> float:
        """Return Σ tr P − Σ log det F; infinity outside."""
        try:
            roots = np.linalg.cholesky(self._slacks(P, steps))
            np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            return math.inf
        diagonals = np.diagonal(roots, axis1=1, axis2=2)
        return float(np.trace(P, axis1=1, axis2=2).sum() - 2 * np.log(diagonals).sum())

    def _newton_step(self, P: _Stack, steps: _Stack) -> tuple[_Stack, float]:
        """Return Newton's change of P, and the decrease of the value that it promises, times 2.

        With G = F^{−1} and a change dP: tr(G dF G dF), dF = dP_v − NᵀdP_wN, has the parts
        G ⊗ G, NGNᵀ ⊗ NGNᵀ and −GNᵀ ⊗ GNᵀ.
        """
        from scipy.sparse import coo_array  # slow to import
        from scipy.sparse.linalg import splu

        count, n = P.shape[:2]
        basis = _symmetric_basis(n)
        size = basis.shape[1]
        G = np.asarray(np.linalg.inv(self._slacks(P, steps)), dtype=np.float64)
        mixed = G @ steps.swapaxes(1, 2)
        ahead = steps @ mixed
        slopes = np.tile(np.eye(n), (count, 1, 1))
        np.add.at(slopes, self.sources, -G)
        np.add.at(slopes, self.targets, ahead)
        slope = (slopes.reshape(count, n * n) @ basis).ravel()

        def products(factors: _Stack) -> _Stack:
            squares = np.einsum("eij,ekl->eikjl", factors, factors)
            return np.asarray(basis.T @ squares.reshape(-1, n * n, n * n) @ basis)

        crossed = -products(mixed)
        blocks = np.concatenate([products(G), products(ahead), crossed, crossed.swapaxes(1, 2)])
        rows = np.concatenate([self.sources, self.targets, self.sources, self.targets]) * size
        columns = np.concatenate([self.sources, self.targets, self.targets, self.sources]) * size
        inner = np.arange(size)
        i = np.broadcast_to(rows[:, None, None] + inner[:, None], blocks.shape)
        j = np.broadcast_to(columns[:, None, None] + inner, blocks.shape)
        shape = (count * size, count * size)
        curvature = coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=shape).tocsc()
        solver = splu(curvature, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        change = -solver.solve(slope)
        return (change.reshape(count, size) @ basis.T).reshape(P.shape), -float(slope @ change)


def _symmetric_basis(n: int) -> Matrix:
    """Return the map from lower triangles to symmetric matrices, (n², n(n+1)/2)."""
    rows, columns = np.tril_indices(n)
    basis = np.zeros((n * n, len(rows)))
    for place in (rows * n + columns, columns * n + rows):
        basis[place, np.arange(len(rows))] = 1.0
    return basis


def _log_growths(
    P: _Stack, matrices: _Stack, sources: NDArray[np.int64], targets: NDArray[np.int64],
    durations: Vector,
) -> Vector:  # fmt: skip
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

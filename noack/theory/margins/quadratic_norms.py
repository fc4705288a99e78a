"""Quadratic norms, one per node of a switched system, that bound its joint spectral radius.

If ‖T_w M x‖ ≤ γ^d ‖T_v x‖ for every edge from v to w with the matrix M and the duration d, no path
grows faster than γ. With P = TᵀT these are linear matrix inequalities, F = P_v − NᵀP_wN ≻ 0 with
N = M γ^−d. The smallest γ is approached from inside, as interior-point methods do: the sum
c log γ + Σ tr P_v − Σ log det F is made small by Newton's method, for larger and larger c.

The bound is computed from the norms with all rounding, so it does not depend on the search. It may
stay above the joint spectral radius. Then there are more norms if the nodes also remember the last
edges (:func:`with_history`), or products of several steps are shorter than γ^duration
(:func:`~noack.theory.margins.joint_spectral_radius.bound_by_products`).
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.margins.exact_matrices import ENLARGED, IntervalMatrix, exactly
from noack.theory.margins.switched_system import Graph, Numbers, SwitchedSystem

if TYPE_CHECKING:
    from scipy.sparse import csc_array  # slow to import

FEW_ENTRIES, MOST_ENTRIES = 1200, 2500
"""Numbers of entries of all P_v with which the search takes some seconds, and up to a minute."""
_FASTEST, _SPREAD = 8, 17
"""Edges by which a node is represented: those that grow most, and some spread over all durations."""
_FIRST_EDGES, _FURTHER_EDGES, _ATTEMPTS = 200, 50, 8
"""Numbers of edges whose inequalities are solved at first, and of the fastest ones added each time; attempts.
Few edges decide the norms, and Newton's method takes a time in proportion to their number."""
_SETTLED = 1e-4
"""No edges are added if the others grow no more than this, in log γ per longest duration."""
_MOST_STAGES, _HEAVIER = 40, 4.0
"""Stages, and the factor of the weight of log γ from one to the next: some Newton steps suffice then."""
_MOST_NEWTON_STEPS, _CENTRED = 40, 0.5
"""Limit of the Newton steps of a stage, which ends at this decrement: twice the decrease still promised."""
_ARMIJO_SHARE, _SHORTEST_STEP = 0.1, 1e-6
"""Share of the promised decrease that a step must have, and the shortest part of a step that is tried."""
_FIRST_DISTANCE = 0.3
"""Distance of the first log γ from the one that holds, per longest duration."""
_GAP = 2e-5
"""Stages end if log γ is nearer to the smallest one than this, per longest duration."""
_LARGEST_LOGARITHM = 300.0
"""Largest logarithm of γ^−d, whose square, by which P is multiplied, must not overflow."""
_SMALLEST = 1e-300
"""Smallest norm of a matrix, whose logarithm is taken."""


class QuadraticNorms(NamedTuple):
    """The norms ‖T_v x‖ of all nodes, and what they prove."""

    system: SwitchedSystem | None
    """The system in the coordinates T_v x; None: it could not be enclosed."""
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
        self._system, self._searched = system, system.graph
        if number_of_entries(system) > most_entries:
            everywhere = np.zeros_like(system.graph.sources)
            self._searched = replace(system.graph, sources=everywhere, targets=everywhere)
        self._coordinates = self._searched.balancing(system.matrices.middle)
        balanced = replace(system, graph=self._searched).in_coordinates(self._coordinates)
        if balanced is None:
            balanced, self._coordinates = (
                system,
                np.tile(np.eye(system.dimension), (self._searched.nodes, 1, 1)),
            )
        self._matrices = balanced.matrices.middle
        share = len(self._matrices) / self._searched.nodes
        self._squares: Stack = np.tile(np.eye(system.dimension) * share, (self._searched.nodes, 1, 1))
        """P_v in balanced coordinates."""

    def improve(self, target: float) -> QuadraticNorms:
        """Improve the norms until they prove a growth, or hardly become better."""
        graph, matrices = self._searched, self._matrices
        goal, settled = math.log(max(target, _SMALLEST)), _SETTLED / graph.durations.max()
        spread = np.unique(np.linspace(0, len(matrices) - 1, _FIRST_EDGES).astype(np.int64))
        numbers = np.union1d([edges[0] for edges in graph.leaving], spread)
        for _ in range(_ATTEMPTS):
            self._squares = _EdgeInequalities(graph, matrices).of(numbers).lower_growth(self._squares, goal)
            growths = _EdgeInequalities(graph, matrices).log_growths(self._squares)
            if growths.max() <= max(growths[numbers].max() + settled, goal):
                break
            numbers = np.union1d(numbers, np.argsort(-growths)[:_FURTHER_EDGES])
        forms = np.linalg.cholesky(self._squares).swapaxes(1, 2) @ self._coordinates
        return self._proven(np.broadcast_to(forms, (self._system.graph.nodes, *forms.shape[1:])))

    def _proven(self, forms: Stack) -> QuadraticNorms:
        durations = self._system.graph.durations
        if (transformed := self._system.in_coordinates(forms)) is None:
            return QuadraticNorms(None, np.full(len(durations), np.inf))
        return QuadraticNorms(transformed, norms_above(transformed.matrices) ** (1 / durations) * (1 + 1e-15))


def number_of_entries(system: SwitchedSystem) -> int:
    """Return the number of entries of one norm for each node."""
    n = system.dimension
    return system.graph.nodes * n * (n + 1) // 2


class _EdgeInequalities(NamedTuple):
    """The inequalities F ≻ 0 of some edges."""

    graph: Graph
    matrices: Stack

    def of(self, numbers: Numbers) -> "_EdgeInequalities":
        """Return those of some edges; each node is still left by one."""
        return _EdgeInequalities(self.graph.at(numbers), self.matrices[numbers])

    def log_growths(self, P: Stack) -> Vector:
        """Return log γ of every edge, (k,)."""
        forms = np.linalg.cholesky(P).swapaxes(1, 2)
        transformed = forms[self.graph.targets] @ self.matrices @ np.linalg.inv(forms)[self.graph.sources]
        norms = np.linalg.norm(transformed, 2, axis=(1, 2))
        return np.asarray(np.log(np.maximum(norms, _SMALLEST)) / self.graph.durations)

    def lower_growth(self, P: Stack, goal: float) -> Stack:
        """Return P for a smaller log γ, at most ``goal`` if that is found."""
        longest, count = float(self.graph.durations.max()), self.matrices[:, 0].size
        known = float(self.log_growths(P).max())
        log_growth = known + _FIRST_DISTANCE / longest
        weight = count * longest
        for _ in range(_MOST_STAGES):
            for _ in range(_MOST_NEWTON_STEPS):
                moved = self._newton_step(P, log_growth, weight)
                if moved is None:
                    break
                P, log_growth, decrement = moved
                if decrement < _CENTRED:
                    break
            known = min(float(self.log_growths(P).max()), log_growth)
            if known < goal or count / weight < _GAP / longest:
                break
            weight *= _HEAVIER
        return P

    def _newton_step(self, P: Stack, log_growth: float, weight: float) -> tuple[Stack, float, float] | None:
        """Return P and log γ after a step of Newton's method, and twice what it promised.

        None: no step along its direction makes the value smaller.
        """
        try:
            change, log_growth_change, decrement = self._direction(P, log_growth, weight)
        except (np.linalg.LinAlgError, RuntimeError):  # singular by rounding
            return None
        value, share = self._value(P, log_growth, weight), 1.0
        while share > _SHORTEST_STEP:
            new = P + share * change, log_growth + share * log_growth_change
            if self._value(*new, weight) < value - _ARMIJO_SHARE * share * decrement:
                return *new, decrement
            share /= 2
        return None

    def _value(self, P: Stack, log_growth: float, weight: float) -> float:
        """Return weight · log γ + Σ tr P − Σ log det F; infinity outside."""
        if not -log_growth * float(self.graph.durations.max()) < _LARGEST_LOGARITHM:
            return math.inf
        try:
            steps = self._steps(log_growth)
            roots = np.linalg.cholesky(P[self.graph.sources] - self._carried(P, steps))
            np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            return math.inf
        diagonals = np.diagonal(roots, axis1=1, axis2=2)
        traces = np.trace(P, axis1=1, axis2=2)
        return float(weight * log_growth + traces.sum() - 2 * np.log(diagonals).sum())

    def _steps(self, log_growth: float) -> Stack:
        """Return N of each edge."""
        return np.asarray(self.matrices * np.exp(-log_growth * self.graph.durations)[:, None, None])

    def _carried(self, P: Stack, steps: Stack) -> Stack:
        """Return NᵀP_wN of each edge."""
        return np.asarray(steps.swapaxes(1, 2) @ P[self.graph.targets] @ steps)

    def _direction(self, P: Stack, log_growth: float, weight: float) -> tuple[Stack, float, float]:
        """Return Newton's change of P and of log γ, and twice the decrease that it promises.

        With G = F^{−1}, the curvature is tr(G dF G dF) with dF = dP_v − NᵀdP_wN + S dlog γ,
        S = 2d NᵀP_wN, and 2d tr(G S) for log γ; the rest would make it indefinite.
        """
        from scipy.sparse.linalg import splu  # slow to import

        sources, targets, durations = self.graph.sources, self.graph.targets, self.graph.durations
        (count, n), steps = P.shape[:2], self._steps(log_growth)
        basis = _symmetric_basis(n)
        carried = self._carried(P, steps)
        G = np.asarray(np.linalg.inv(P[sources] - carried), dtype=np.float64)
        S = 2 * durations[:, None, None] * carried
        mixed, transformed = G @ steps.swapaxes(1, 2), G @ S

        def of_nodes(edges: Stack, first: Matrix) -> Vector:
            """Return Σ tr(X dF) as a function of all P, for X of each edge, and tr(Y dP_v)."""
            total = np.tile(first, (count, 1, 1))
            np.add.at(total, sources, edges)
            np.add.at(total, targets, -steps @ edges @ steps.swapaxes(1, 2))
            return np.asarray((total.reshape(count, n * n) @ basis).ravel())

        curvature = self._curvature(basis, G, mixed, steps @ mixed, count)
        solver = splu(curvature, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        # Newton's equations, bordered by that of log γ.
        slope, border = of_nodes(-G, np.eye(n)), of_nodes(transformed @ G, np.zeros((n, n)))
        along, across = solver.solve(slope), solver.solve(border)
        sums = np.trace(transformed, axis1=1, axis2=2)
        own_slope = weight - float(sums.sum())
        corner = float(np.einsum("eij,eji->", transformed, transformed) + 2 * durations @ sums)
        corner -= float(border @ across)
        if not corner > 0:
            raise np.linalg.LinAlgError
        log_growth_change = -(own_slope - float(border @ along)) / corner
        change = -along - log_growth_change * across
        decrement = -float(slope @ change) - own_slope * log_growth_change
        return (change.reshape(count, -1) @ basis.T).reshape(P.shape), log_growth_change, decrement

    def _curvature(
        self, basis: Matrix, G: Stack, mixed: Stack, carried: Stack, count: int
    ) -> "csc_array[np.float64]":
        """Return the curvature in the entries of all P: a block for each pair of an edge's nodes.

        Args:
            basis: the map from the entries of a P to the P.
            G: F^{−1} of each edge.
            mixed: G Nᵀ of each edge.
            carried: N G Nᵀ of each edge.
            count: number of nodes.
        """
        from scipy.sparse import coo_array  # slow to import

        size = basis.shape[1]
        sources, targets = self.graph.sources, self.graph.targets
        parts: list[tuple[Stack, Numbers, Numbers]] = []
        for factors, first, second in ((G, sources, sources), (carried, targets, targets)):
            parts.append(_sum_by_pair(basis, factors, first, second))
        crossed, first, second = _sum_by_pair(basis, mixed, sources, targets)
        parts += [(-crossed, first, second), (-crossed.swapaxes(1, 2), second, first)]
        blocks, block_rows, block_columns = map(np.concatenate, zip(*parts, strict=True))
        rows, columns = block_rows * size, block_columns * size
        inner = np.arange(size)
        i = np.broadcast_to(rows[:, None, None] + inner[:, None], blocks.shape)
        j = np.broadcast_to(columns[:, None, None] + inner, blocks.shape)
        shape = (count * size, count * size)
        return coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=shape).tocsc()


def _sum_by_pair(
    basis: Matrix, factors: Stack, first: Numbers, second: Numbers
) -> tuple[Stack, Numbers, Numbers]:
    """Return the sum of basisᵀ (G ⊗ G) basis over the edges between each two nodes, and the nodes.

    Summed before anything else is done: many edges have the same nodes.
    """
    n = factors.shape[1]
    order = np.lexsort((second, first))
    ends = np.stack([first, second])[:, order]
    begins = np.flatnonzero(np.any(np.diff(ends, prepend=-1), axis=0))
    groups = np.split(factors.reshape(-1, n * n)[order], begins[1:])
    squares = np.array([np.einsum("ea,eb->ab", group, group) for group in groups])
    squares = squares.reshape(-1, n, n, n, n).swapaxes(2, 3).reshape(-1, n * n, n * n)
    return basis.T @ squares @ basis, *ends[:, begins]


def _symmetric_basis(n: int) -> Matrix:
    """Return the map from lower triangles to symmetric matrices, (n², n(n+1)/2)."""
    rows, columns = np.tril_indices(n)
    basis = np.zeros((n * n, len(rows)))
    for position in (rows * n + columns, columns * n + rows):
        basis[position, np.arange(len(rows))] = 1.0
    return basis


def with_history(system: SwitchedSystem, classes: int) -> SwitchedSystem:
    """Return the same system with nodes that also remember the class of the last edge.

    The classes have equal numbers of edges, in the order of the edges. More norms give a smaller
    bound (Ahmadi, Jungers, Parrilo and Roozbehani, *SIAM J. Control Optim.* 52, 2014). Each edge
    becomes ``classes`` successive ones.
    """
    graph, edge_classes = system.graph, np.zeros_like(system.graph.sources)
    for node in range(graph.nodes):
        reaching = np.flatnonzero(graph.targets == node)
        edge_classes[reaching] = np.arange(len(reaching)) * classes // len(reaching)
    sources = (graph.sources[:, None] * classes + np.arange(classes)).ravel()
    targets = np.repeat(graph.targets * classes + edge_classes, classes)
    numbers = np.repeat(np.arange(len(edge_classes)), classes)
    return SwitchedSystem(Graph(sources, targets, graph.durations[numbers]), system.matrices.at(numbers))


def representatives(graph: Graph, growths: Vector) -> Numbers:
    """Return some edges that leave each node: those that grow most, and some of each duration."""
    chosen: list[Numbers] = []
    for edges in graph.leaving:
        by_duration = edges[np.argsort(graph.durations[edges], kind="stable")]
        spread = np.linspace(0, len(by_duration) - 1, min(_SPREAD, len(by_duration))).round().astype(np.int64)
        chosen += [edges[np.argsort(-growths[edges], kind="stable")][:_FASTEST], by_duration[spread]]
    return np.unique(np.concatenate(chosen))


def norms_above(matrices: IntervalMatrix) -> Vector:
    """Return upper bounds of the Euclidean norms of all matrices of enclosures, (k, m, n) → (k,).

    With the computed eigenvectors V of MᵀM, ‖MᵀM‖ ≤ ‖VᵀMᵀMV‖ ‖V^{−1}‖². The first norm is at most
    the largest sum of a row, and ‖V^{−1}‖² ≤ 1/(1 − ‖I − VᵀV‖).
    """
    M, transposed = matrices, matrices.transposed
    V = exactly(np.linalg.eigh(transposed.middle @ M.middle)[1])
    square = V.transposed @ (transposed @ M) @ V
    defect = exactly(np.eye(M.middle.shape[2])) - V.transposed @ V
    size, missed = (matrix.magnitude.sum(axis=2).max(axis=1) for matrix in (square, defect))
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.sqrt(size / (1 - missed)) * ENLARGED
    return np.where((missed < 0.5) & ~np.isnan(bounds), bounds, np.inf)

"""Growth under the worst losses, and cost, of a time-triggered loop: quickly, with rounding.

A search tries thousands of gains. For each, the loop's maps are computed in double precision, and
a search for cycles of few edges gives a lower bound of the growth. It excludes gains; it proves
nothing. :mod:`noack.theory.margins` decides about what is left.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_lyapunov

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.impairments.loss_guarantee import outcome_letters
from noack.theory.margins.exact_matrices import Arithmetic, IntervalMatrix
from noack.theory.margins.loss_margin import Burst
from noack.theory.margins.time_triggered_loop import LoopTimes, TimeTriggeredLoop

Indices = NDArray[np.int64]
_ROUNDS, _MOST_ROUNDS, _BEAM, _BALANCING = 5, 40, 24, 12
_TINY = 1e-300


@dataclass(frozen=True)
class CostedMatrix:
    """The map of a state over some time, and the cost of this time: z becomes M z, zᵀ C z is paid.

    Rows of a map keep its cost; of matrices on top of each other, the first one has the cost.
    """

    matrix: Matrix
    """M, (k, n)."""
    cost: Matrix
    """C, (n, n)."""

    def __matmul__(self, other: "CostedMatrix") -> "CostedMatrix":
        """Return the map over both times, of which that of ``other`` is the first."""
        M = other.matrix
        return CostedMatrix(self.matrix @ M, other.cost + M.T @ self.cost @ M)

    def rows(self, which: slice | list[int]) -> "CostedMatrix":
        """Return some of the rows."""
        return CostedMatrix(self.matrix[which], self.cost)

    def interval(self) -> IntervalMatrix:
        """Return the map as if it were known exactly."""
        return IntervalMatrix(self.matrix, np.zeros_like(self.matrix))


def _free(matrix: Matrix) -> CostedMatrix:
    return CostedMatrix(matrix, np.zeros((matrix.shape[1], matrix.shape[1])))


def _stacked(*parts: CostedMatrix) -> CostedMatrix:
    return CostedMatrix(np.concatenate([part.matrix for part in parts]), parts[0].cost)


def costed(weight: Matrix) -> Arithmetic[CostedMatrix]:
    """Return the arithmetic in which a flow of states z costs ∫ zᵀ weight z dt."""

    def exponential(generator: Matrix, dt_ns: int) -> CostedMatrix:
        dt_s, n = dt_ns / NS_PER_S, len(generator)
        if n != len(weight):  # the flow of a model, not of the loop
            return _free(expm(generator * dt_s))
        # Van Loan, IEEE Trans. Autom. Control 23(3), 1978.
        block = np.block([[-generator.T, weight], [np.zeros((n, n)), generator]])
        exponentiated = expm(block * dt_s)
        M = exponentiated[n:, n:]
        return CostedMatrix(M, M.T @ exponentiated[:n, n:])

    return Arithmetic(_free, exponential, _stacked)


class QuickLoop:
    """A loop with the matrices A, B, K, H in double precision; Q and R weigh x and u."""

    def __init__(
        self,
        matrices: tuple[Matrix, Matrix, Matrix, Matrix],
        times: LoopTimes,
        weights: tuple[Matrix, Matrix],
    ) -> None:
        n, m = matrices[1].shape
        weight = np.zeros((2 * (n + m), 2 * (n + m)))
        weight[:n, :n], weight[2 * n : 2 * n + m, 2 * n : 2 * n + m] = weights
        self._n, self._m = n, m
        self.loop = TimeTriggeredLoop(matrices, times, costed(weight))

    def cost(self, x0: Vector) -> float:
        """Return ∫ xᵀQx + uᵀRu dt from x(0) with every update delivered; infinite if unstable.

        The controller knows x(0), and the input is 0 until its first tick.
        """
        whole = self.loop.period_map(0, delivered=True)
        for slot in range(1, self.loop.times.slots):
            whole = self.loop.period_map(slot, delivered=True) @ whole
        if not np.isfinite(whole.matrix).all() or not _radius(whole.matrix) < 1 - 1e-9:
            return np.inf
        z0 = np.concatenate([x0, x0, np.zeros(2 * self._m)])
        return float(z0 @ solve_discrete_lyapunov(whole.matrix.T, whole.cost) @ z0)

    def maps(self, bursts: Sequence[Burst]) -> Matrix:
        """Return the maps of bursts between two deliveries, (k, d, d)."""
        return np.array([self.loop.map(one.slot, one.steps - 1).middle for one in bursts])


def _radius(matrix: Matrix) -> float:
    return float(np.abs(np.linalg.eigvals(matrix)).max())


class QuickGrowth(NamedTuple):
    """A lower bound of the growth, up to rounding."""

    logarithm: float
    """log of the growth per period."""
    cycle: tuple[int, ...]
    """The numbers of the edges that grow so fast, in their order of time."""


class PatternGraph:
    """The graph of a guarantee, with the cycles that were the worst ones of loops seen so far."""

    def __init__(self, bursts: Sequence[Burst]) -> None:
        self.bursts = bursts
        self._sources = np.array([one.source for one in bursts])
        self._targets = np.array([one.target for one in bursts])
        self._durations = np.array([one.steps for one in bursts])
        nodes = range(int(self._sources.max()) + 1)
        self._leaving = [np.flatnonzero(self._sources == node) for node in nodes]
        self._rounds = min(_ROUNDS + len(self._leaving), _MOST_ROUNDS)
        self._known: dict[tuple[int, ...], None] = {}

    def growth(self, maps: Matrix) -> QuickGrowth:
        """Return the fastest growth found, of short cycles and those known before."""
        if not np.isfinite(maps).all() or np.abs(maps).max() > 1e150:
            return QuickGrowth(np.inf, ())
        turned, best = self._balanced(maps), QuickGrowth(-np.inf, ())
        for cycle in self._known:
            product, duration = np.eye(maps.shape[1]), 0
            for number in cycle:
                product = turned[number] @ product
                duration += int(self._durations[number])
            best = max(best, QuickGrowth(np.log(_radius(product) + _TINY) / duration, cycle))
        best = max(best, self._searched(turned, best.logarithm))
        if best.cycle:
            self._known[best.cycle] = None
        return best

    def remember(self, pattern: Sequence[bool]) -> None:
        """Let all later loops be tried with a pattern that repeats, too; it begins with D."""
        losses = [len(part) for part in outcome_letters(pattern).split("D")[1:]]
        for start in range(len(self._leaving)):
            node, cycle = start, list[int]()
            for count in losses:
                leaving: list[int] = self._leaving[node].tolist()
                steps = [i for i in leaving if self.bursts[i].losses == count]
                if not steps:
                    break
                cycle.append(steps[0])
                node = self.bursts[cycle[-1]].target
            if cycle and len(cycle) == len(losses) and node == start:
                self._known[tuple(cycle)] = None

    def _balanced(self, maps: Matrix) -> Matrix:
        """Return the maps in coordinates in which no direction grows much more than others."""
        P = np.eye(maps.shape[1])
        for _ in range(_BALANCING):
            P = (maps.swapaxes(1, 2) @ (P @ maps)).sum(axis=0)
            size = float(np.trace(P))
            if not 0 < size < np.inf:
                return maps
            P = P / size + 1e-6 * np.eye(len(P))
        T = np.linalg.cholesky(P).T
        return np.asarray(T @ maps @ np.linalg.inv(T))

    def _searched(self, maps: Matrix, at_least: float) -> QuickGrowth:
        best = QuickGrowth(at_least, ())
        paths, products = np.arange(len(maps))[:, None], maps
        durations = self._durations.astype(float)
        for _ in range(self._rounds):
            norms = np.log(np.linalg.norm(products, axis=(1, 2)) + _TINY) / durations
            closed = np.flatnonzero(
                (self._sources[paths[:, 0]] == self._targets[paths[:, -1]])
                & (norms > best.logarithm)
            )
            if len(closed):
                radii = np.abs(np.linalg.eigvals(products[closed])).max(axis=1)
                growths = np.log(radii + _TINY) / durations[closed]
                fastest = int(growths.argmax())
                if growths[fastest] > best.logarithm + 1e-12:
                    cycle = tuple(paths[closed[fastest]].tolist())
                    best = QuickGrowth(float(growths[fastest]), cycle)
            rank = durations * (norms - max(best.logarithm, -50.0))
            kept = np.argsort(-rank, kind="stable")[:_BEAM]
            steps = [self._leaving[self._targets[paths[index, -1]]] for index in kept]
            before = np.repeat(kept, [len(one) for one in steps])
            step = np.concatenate(steps)
            paths = np.concatenate([paths[before], step[:, None]], axis=1)
            products = maps[step] @ products[before]
            durations = durations[before] + self._durations[step]
        return best

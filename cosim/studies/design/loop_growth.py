"""Growth under the worst losses, and cost, of a time-triggered loop: quickly, with rounding.

A search tries thousands of gains. For each, the loop's maps are computed in double precision, and
short cycles give a lower bound of the growth. It excludes gains; it proves nothing.
:mod:`noack.theory.margins` has the exact maps, and decides about what is left.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, solve_discrete_lyapunov

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.theory.margins.loss_margin import Burst
from noack.theory.margins.time_triggered_loop import LoopTimes

_ROUNDS, _MOST_ROUNDS, _BEAM, _BALANCING = 5, 40, 24, 12
_TINY = 1e-300


class _Map(NamedTuple):
    """The map of a state over some time, z to M z, and the cost of this time, zᵀ C z."""

    M: Matrix
    C: Matrix

    def after(self, first: "_Map") -> "_Map":
        return _Map(self.M @ first.M, first.C + first.M.T @ self.C @ first.M)


class QuickLoop:
    """A loop of the times of :class:`TimeTriggeredLoop`, with (x, x_c, u, w) as its state.

    Args:
        matrices: A, (n, n), B, (n, m), K, (m, n), and H, (n, n).
        times: the times of the loop.
        weights: Q and R, the weights of x and u in the cost.
    """

    def __init__(
        self,
        matrices: tuple[Matrix, Matrix, Matrix, Matrix],
        times: LoopTimes,
        weights: tuple[Matrix, Matrix],
    ) -> None:
        A, B, K, H = matrices
        n, m = B.shape
        self.times, self._m, size = times, m, 2 * (n + m)
        x, x_c, u, w = np.split(np.eye(size), [n, 2 * n, 2 * n + m])
        self._generator = x.T @ A @ x + x_c.T @ H @ x_c + x.T @ B @ u
        self._weight = x.T @ weights[0] @ x + u.T @ weights[1] @ u
        without_update = w if times.holds_input else 0 * w
        self._latch = np.vstack([x, x_c, w, w])
        self._ticks = [np.vstack([x, x_c, u, sent]) for sent in (K @ x_c, without_update)]
        self._x_c, self._arrived = slice(n, 2 * n), expm(H * (times.delay_ns / NS_PER_S)) @ x
        self._flow, self._lost = cache(self._exponential), cache(self._lost_period)
        self._delivered = cache(self._delivered_period)
        self._z = np.eye(size), np.eye(size)
        if not times.delay_ns:  # just after a delivery x_c = x and w = u
            self._z = np.vstack([x, u]), np.vstack([x, x, u, u]) @ np.vstack([x, u]).T

    def _exponential(self, dt_ns: int) -> _Map:
        """Return the flow over dt (Van Loan, IEEE Trans. Autom. Control 23(3), 1978)."""
        G, n = self._generator, len(self._generator)
        block = np.block([[-G.T, self._weight], [np.zeros((n, n)), G]])
        exponential = expm(block * (dt_ns / NS_PER_S))
        M = exponential[n:, n:]
        return _Map(M, M.T @ exponential[:n, n:])

    def _between(self, from_ns: int, until_ns: int, timeout_ns: int) -> _Map:
        """Return the map from a time to another; a tick at its end is excluded, a step at 0."""
        split_ns = min(max(timeout_ns, from_ns), until_ns)
        in_time = self._cycles(from_ns, split_ns, is_late=False)
        if split_ns == until_ns:
            return in_time
        return self._cycles(split_ns, until_ns, is_late=True).after(in_time)

    def _cycles(self, from_ns: int, until_ns: int, *, is_late: bool) -> _Map:
        times = self.times
        cycle_ns = int(np.lcm(times.step_ns, times.tick_ns))
        cycles, rest_ns = divmod(until_ns - from_ns, cycle_ns)
        remainder = self._occurrences(from_ns, from_ns + rest_ns, is_late)
        square = self._occurrences(from_ns + rest_ns, from_ns + rest_ns + cycle_ns, is_late)
        while cycles:
            if cycles & 1:
                remainder = square.after(remainder)
            cycles, square = cycles >> 1, square.after(square)
        return remainder

    def _occurrences(self, from_ns: int, until_ns: int, is_late: bool) -> _Map:
        none = np.zeros_like(self._generator)
        passed, now_ns = _Map(np.eye(len(none)), none), from_ns
        for t_ns, is_tick in self.times.occurrences(from_ns, until_ns):
            matrix = self._ticks[is_late] if is_tick else self._latch
            passed = _Map(matrix, none).after(self._flow(t_ns - now_ns).after(passed))
            now_ns = t_ns
        return self._flow(until_ns - now_ns).after(passed)

    def _lost_period(self, slot: int, usable_ns: int) -> _Map:
        """Return the map of a period whose update is lost; x_c is used for some time."""
        from_ns = slot * self.times.period_ns
        return self._between(from_ns, from_ns + self.times.period_ns, from_ns + usable_ns)

    def _delivered_period(self, slot: int, usable_ns: int) -> _Map:
        """Return the map of a period whose update is delivered; x_c before it is used for some time."""
        from_ns = slot * self.times.period_ns
        until_ns, arrival_ns = from_ns + self.times.period_ns, from_ns + self.times.delay_ns
        first = self._between(from_ns, arrival_ns, from_ns + usable_ns)
        second = self._between(arrival_ns, until_ns, from_ns + self.times.timeout_ns)
        arrived = first.M.copy()
        arrived[self._x_c] = self._arrived
        return second.after(_Map(arrived, first.C))

    def cost(self, x0: Vector) -> float:
        """Return ∫ xᵀQx + uᵀRu dt from x(0) with every update delivered; infinite if unstable.

        The controller knows x(0), and the input is 0 until its first tick.
        """
        usable_ns = self.times.usable_ns(1, self.times.delay_ns)
        round_map = self._delivered(0, usable_ns)
        for slot in range(1, self.times.slots):
            round_map = self._delivered(slot, usable_ns).after(round_map)
        if not np.isfinite([round_map.M, round_map.C]).all() or not _radius(round_map.M) < 1 - 1e-9:
            return np.inf
        z0 = np.concatenate([x0, x0, np.zeros(2 * self._m)])
        return float(z0 @ solve_discrete_lyapunov(round_map.M.T, round_map.C) @ z0)

    def maps(self, bursts: Sequence[Burst]) -> Matrix:
        """Return the maps of bursts between two deliveries, (k, d, d)."""
        (rows, start), times, maps = self._z, self.times, []
        for burst in bursts:
            M = self._delivered(burst.slot, burst.usable_ns).M @ start
            for number in range(1, burst.losses + 1):
                usable_ns = times.usable_ns(number, times.period_ns)
                M = self._lost((burst.slot + number) % times.slots, usable_ns).M @ M
            maps.append(rows @ M)
        return np.array(maps)


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
        self._sources = np.array([burst.source for burst in bursts])
        self._targets = np.array([burst.target for burst in bursts])
        self._durations = np.array([float(burst.steps) for burst in bursts])
        nodes = range(int(self._sources.max()) + 1)
        self._leaving = [np.flatnonzero(self._sources == node) for node in nodes]
        self._rounds = min(_ROUNDS + len(nodes), _MOST_ROUNDS)
        self._known: dict[tuple[int, ...], None] = {}

    def growth(self, maps: Matrix) -> QuickGrowth:
        """Return the fastest growth found, of short cycles and those known before."""
        if not np.isfinite(maps).all() or np.abs(maps).max() > 1e150:
            return QuickGrowth(np.inf, ())
        turned, best = _balanced(maps), QuickGrowth(-np.inf, ())
        for cycle in self._known:
            product = np.eye(maps.shape[1])
            for number in cycle:
                product = turned[number] @ product
            logarithm = np.log(_radius(product) + _TINY) / self._durations[list(cycle)].sum()
            best = max(best, QuickGrowth(float(logarithm), cycle))
        best = max(best, self._searched(turned, best.logarithm))
        if best.cycle:
            self._known[best.cycle] = None
        return best

    def _searched(self, maps: Matrix, at_least: float) -> QuickGrowth:
        """Keep, at each length, the paths with the largest products."""
        best = QuickGrowth(at_least, ())
        paths, products, durations = np.arange(len(maps))[:, None], maps, self._durations
        for _ in range(self._rounds):
            norms = np.log(np.linalg.norm(products, axis=(1, 2)) + _TINY) / durations
            closed = np.flatnonzero(
                (self._sources[paths[:, 0]] == self._targets[paths[:, -1]]) & (norms > best.logarithm)
            )
            if len(closed):
                radii = np.abs(np.linalg.eigvals(products[closed])).max(axis=1)
                growths = np.log(radii + _TINY) / durations[closed]
                fastest = int(growths.argmax())
                if growths[fastest] > best.logarithm + 1e-12:
                    cycle = tuple(paths[closed[fastest]].tolist())
                    best = QuickGrowth(float(growths[fastest]), cycle)
            rank = durations * (norms - max(best.logarithm, -50.0))
            best_paths = np.argsort(-rank, kind="stable")[:_BEAM]
            steps = [self._leaving[self._targets[paths[index, -1]]] for index in best_paths]
            extended, step = np.repeat(best_paths, [len(edges) for edges in steps]), np.concatenate(steps)
            paths = np.concatenate([paths[extended], step[:, None]], axis=1)
            products = maps[step] @ products[extended]
            durations = durations[extended] + self._durations[step]
        return best


def _balanced(maps: Matrix) -> Matrix:
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

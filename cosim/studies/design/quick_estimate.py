"""Growth under the worst losses, and cost, of a time-triggered loop: quickly, with rounding.

A search tries thousands of gains. For each, the loop's maps are computed in double precision, and
short cycles give a lower bound of the growth. It excludes gains; it proves nothing.
:mod:`noack.theory.witnesses.growth` decides about what is left.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, reduce
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, solve_discrete_lyapunov

from noack.core.linear_systems import Matrix, Stack, Vector
from noack.proof.period_times import LoopTimes
from noack.proof.search.growth import Burst
from noack.theory.time_triggered.graph import Graph, spectral_radii
from noack.theory.time_triggered.time_triggered_loop import Timeline

_FURTHER_EDGES, _MOST_EDGES = 5, 40
"""Edges of the longest cycles, beyond the number of nodes, and in all."""
_BEAM, _BALANCING_STEPS = 24, 12
"""Paths that the search for a cycle continues, and iterations of its coordinates."""
_TINY = 1e-300


class _Map(NamedTuple):
    """The map of a state over some time, z to M z, and the cost of this time, zᵀ C z."""

    M: Matrix
    C: Matrix

    def then(self, later: "_Map") -> "_Map":
        return _Map(later.M @ self.M, self.C + self.M.T @ later.C @ self.M)


class QuickLoop:
    """A loop of the times of :class:`TimeTriggeredLoop`, with (x, x_c, u, w, older x) as its state.

    The older x are those of the transmissions before whose updates are on their way.

    Args:
        matrices: A, (n, n), B, (n, m), K, (m, n), and H, (n, n).
        times: the times of the loop.
        weights: Q and R, the weights of x and u in the cost.
        latest: for every slot, how long after a transmission an update arrives at the latest; by default
            the delay. The cost is that of the latest arrivals.
    """

    def __init__(
        self,
        matrices: tuple[Matrix, Matrix, Matrix, Matrix],
        times: LoopTimes,
        weights: tuple[Matrix, Matrix],
        latest: Sequence[int] = (),
    ) -> None:
        A, B, K, H = matrices
        n, m = B.shape
        self.times, self._first_older = times, 2 * (n + m)
        sizes = np.cumsum([n, n, m, m, *[n] * times.behind])
        size = sizes[-1]
        x, x_c, u, w, *older = np.split(np.eye(size), sizes[:-1])
        sent = [x, *older]
        self._generator = x.T @ A @ x + x_c.T @ H @ x_c + x.T @ B @ u
        self._weight = x.T @ weights[0] @ x + u.T @ weights[1] @ u
        without_update = w if times.holds_input else 0 * w
        occurrences = [(x, x_c, w, w), (x, x_c, u, K @ x_c), (x, x_c, u, without_update)]
        steps = (_Map(np.vstack([*rows, *older]), np.zeros((size, size))) for rows in occurrences)
        self._between = Timeline(times, self._exponential, *steps).between
        self._latest = latest or [times.delay] * times.slots
        self._x_c, self._H, self._oldest = slice(n, 2 * n), H, sent[-1]
        self._shifted = np.vstack([np.zeros((0, size)), *sent[:-1]])
        self._none = _Map(np.eye(size), np.zeros((size, size)))
        self._lost, self._delivered = cache(self._lost_period), cache(self._delivered_period)
        self._arrived = cache(self._state_on_arrival)
        self._z = np.eye(size), np.eye(size)
        if times.behind + max(self._latest) == 0:  # just after a delivery x_c = x and w = u
            self._z = np.vstack([x, u]), np.vstack([x, x, u, u]) @ np.vstack([x, u]).T

    def _exponential(self, dt: int) -> _Map:
        """Return the flow over dt (Van Loan, IEEE Trans. Autom. Control 23(3), 1978)."""
        G, n = self._generator, len(self._generator)
        block = np.block([[-G.T, self._weight], [np.zeros((n, n)), G]])
        exponential = expm(block * self.times.seconds(dt))
        M = exponential[n:, n:]
        return _Map(M, M.T @ exponential[:n, n:])

    def _lost_period(self, slot: int, usable: int) -> _Map:
        """Return the map of a period without an arrival; x_c is used for some time."""
        begin = slot * self.times.period
        return self._shift(self._between(begin, begin + self.times.period, begin + usable))

    def _state_on_arrival(self, delay: int) -> Matrix:
        """Return the rows of x_c after an update that arrives so long after a transmission."""
        whole_delay = self.times.behind * self.times.period + delay
        return expm(self._H * self.times.seconds(whole_delay)) @ self._oldest

    def _delivered_period(self, slot: int, usable: int, delay: int) -> _Map:
        """Return the map of a period with an arrival; x_c before it is used for some time."""
        begin = slot * self.times.period
        end, arrival = begin + self.times.period, begin + delay
        first = self._between(begin, arrival, begin + usable)
        second = self._between(arrival, end, begin + self.times.timeout)
        M = first.M.copy()
        M[self._x_c] = self._arrived(delay)
        return self._shift(_Map(M, first.C).then(second))

    def _shift(self, period: _Map) -> _Map:
        """Return a period at whose end each older x is that of one transmission later."""
        M = period.M.copy()
        M[self._first_older :] = self._shifted
        return _Map(M, period.C)

    def cost(self, x0: Vector) -> float:
        """Return ∫ xᵀQx + uᵀRu dt from x(0) with every update delivered; infinite if unstable.

        The controller knows x(0), and the input is 0 until its first tick.
        """
        times = self.times
        usable = times.usable(1, max(self._latest))
        before = reduce(
            _Map.then,
            (self._lost(slot % times.slots, times.period) for slot in range(times.behind)),
            self._none,
        )
        slots = range(times.behind, times.behind + times.slots)
        periods = (slot % times.slots for slot in slots)
        whole = reduce(_Map.then, (self._delivered(slot, usable, self._latest[slot]) for slot in periods))
        if not np.isfinite([whole.M, whole.C]).all() or not spectral_radii(whole.M) < 1 - 1e-9:
            return np.inf
        z0 = np.zeros(len(whole.M))
        z0[: 2 * len(x0)] = np.tile(x0, 2)
        first = before.M @ z0
        later = first @ solve_discrete_lyapunov(whole.M.T, whole.C) @ first
        return float(z0 @ before.C @ z0 + later)

    def maps(self, bursts: Sequence[Burst]) -> Matrix:
        """Return the maps of bursts between two deliveries, (k, d, d)."""
        (rows, start), times, maps = self._z, self.times, []
        for burst in bursts:
            arrival = times.delay if burst.arrival is None else burst.arrival
            M = self._delivered(burst.slot, burst.usable, arrival).M @ start
            for number in range(1, burst.losses + 1):
                usable = times.usable(number, times.period)
                M = self._lost((burst.slot + number) % times.slots, usable).M @ M
            maps.append(rows @ M)
        return np.array(maps)


class PatternGraph:
    """The graph of a guarantee, with the cycles that were the worst ones of loops seen so far."""

    def __init__(self, bursts: Sequence[Burst]) -> None:
        self.bursts = bursts
        ends = (np.array(part) for part in zip(*((b.source, b.target, b.units) for b in bursts), strict=True))
        self._graph = Graph(*ends)
        self._most_edges = min(_FURTHER_EDGES + self._graph.nodes, _MOST_EDGES)
        self._cycles: dict[tuple[int, ...], None] = {}

    def growth(self, maps: Stack) -> float:
        """Return a lower bound of log growth per period, up to rounding.

        It is that of the fastest cycle found, of short ones and those known before.
        """
        if not np.isfinite(maps).all() or np.abs(maps).max() > 1e150:
            return math.inf
        zeros = np.zeros_like(self._graph.sources)
        (T,) = replace(self._graph, sources=zeros, targets=zeros).balancing(maps, _BALANCING_STEPS)
        balanced, best = T @ maps @ np.linalg.inv(T), -math.inf
        for cycle in self._cycles:
            product = reduce(lambda before, edge: balanced[edge] @ before, cycle, np.eye(len(T)))
            duration = self._graph.durations[list(cycle)].sum()
            best = max(best, float(np.log(spectral_radii(product) + _TINY) / duration))
        best, faster = self._graph.fastest_cycle(balanced, self._most_edges, _BEAM, best)
        if faster:
            self._cycles[faster] = None
        return best

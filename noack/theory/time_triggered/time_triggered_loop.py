"""The loop of a time-triggered sensor from one transmission to the next, as a linear map without rounding.

Every T the sensor transmits x. The loop is that of the processes, with no step late:

* at kh the plant, ẋ = Ax + Bu, replaces its input u by the newest actuation w that it has received;
* at its ticks φ, φ + τ, … the controller sends w = K x_c; it arrives at once, after a step of the
  plant at the same time;
* a tick at least Θ after the time of the newest update sends w = 0 instead, or w once more;
* between updates ẋ_c = H x_c; an update of time t_k that arrives at t_k + d sets x_c to
  e^{Hd} x(t_k). At one time, the order is: step of the plant, transmission, arrival, tick.
"""

import math
from collections.abc import Callable
from functools import cache, reduce
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from flint import arb_mat, ctx

from noack.core.balls import identity, matrix, number, rows_of, stack
from noack.core.linear_systems import Matrix, balancing_exponents
from noack.proof.period_times import NEVER, LoopTimes
from noack.theory.time_triggered.exact_matrices import IntervalMatrix, enclosing

_BITS = 512
"""Of a ball's midpoint: products of hundreds of steps lose far fewer."""


class TimedMap(Protocol):
    """A map of the state over some time."""

    def then(self, later: Self) -> Self:
        """Return this map and the one after it."""


_Map = TypeVar("_Map", bound=TimedMap)


def repeated(part: _Map, times: int) -> _Map:
    """Return a map once or more often in sequence, by repeated squaring."""
    whole = part
    for digit in f"{times:b}"[1:]:
        whole = whole.then(whole)
        if digit == "1":
            whole = whole.then(part)
    return whole


class Timeline(Generic[_Map]):
    """The maps of (x, x_c, u, w) while no update arrives, in any arithmetic.

    Args:
        times: times of the loop.
        flow: the map over a time between steps and ticks.
        latch: the map of a step of the plant.
        tick: the map of a tick of the controller.
        late_tick: the map of a tick when no update is new enough.
    """

    def __init__(
        self, times: LoopTimes, flow: Callable[[int], _Map], latch: _Map, tick: _Map, late_tick: _Map
    ) -> None:
        self._times, self._flow, self._latch = times, cache(flow), latch
        self._ticks = tick, late_tick
        self._cycle = math.lcm(times.step, times.tick)
        self._advance = cache(self._advance_from_cycle)

    def between(self, begin: int, end: int, timeout: int = NEVER) -> _Map:
        """Return the map between two times; a tick at the end is excluded, and a step at the start.

        From ``timeout`` on the ticks are late.
        """
        split = min(max(timeout, begin), end)
        in_time = self._advance(begin % self._cycle, split - begin, False)
        if split == end:
            return in_time
        return in_time.then(self._advance(split % self._cycle, end - split, True))

    def _advance_from_cycle(self, begin: int, duration: int, is_late: bool) -> _Map:
        cycles, rest = divmod(duration, self._cycle)
        last_part = self._occurrences(begin, begin + rest, is_late)
        if not cycles:
            return last_part
        return repeated(self._occurrences(begin, begin + self._cycle, is_late), cycles).then(last_part)

    def _occurrences(self, begin: int, end: int, is_late: bool) -> _Map:
        parts, now = list[_Map](), begin
        for t, is_tick in self._times.occurrences(begin, end):
            parts += [self._flow(t - now), self._ticks[is_late] if is_tick else self._latch]
            now = t
        return reduce(lambda first, later: first.then(later), [*parts, self._flow(end - now)])


class _BallMap(NamedTuple):
    """The map of a state, z to M z, as a matrix of balls."""

    M: arb_mat

    def then(self, later: "_BallMap") -> "_BallMap":
        return _BallMap(later.M * self.M)


class TimeTriggeredLoop:
    """The maps of a loop with the matrices A, (n, n), B, (n, m), K, (m, n), and H, (n, n)."""

    def __init__(self, A: Matrix, B: Matrix, K: Matrix, H: Matrix, times: LoopTimes) -> None:
        n, m = B.shape
        # In similar units, powers of two, products have much smaller errors.
        couplings = np.block([[np.maximum(abs(A), abs(H)), abs(B)], [abs(K), np.zeros((m, m))]])
        exponents = balancing_exponents(couplings)
        of_x, of_u = np.split(exponents[:, None], [n])
        A, H = np.ldexp(A, of_x - of_x.T), np.ldexp(H, of_x - of_x.T)
        B, K = np.ldexp(B, of_x - of_u.T), np.ldexp(K, of_u - of_x.T)
        self.times, self._H = times, matrix(H.tolist())
        # The state of the loop is (x, x_c, u, w).
        size = 2 * (n + m)
        generator = np.zeros((size, size))
        generator[:n, :n], generator[n : 2 * n, n : 2 * n] = A, H
        generator[:n, 2 * n : 2 * n + m] = B
        x, x_c, u, w = np.split(np.eye(size), [n, 2 * n, 2 * n + m])
        self._x, self._inputs, self._loop = range(n), range(2 * n, size), range(size)
        self._older = [range(size + i * n, size + (i + 1) * n) for i in range(times.behind)]
        """x of the transmissions before, the newest one first."""
        without_update = w if times.holds_input else 0 * w
        occurrences = [(x, x_c, w, w), (x, x_c, u, K @ x_c), (x, x_c, u, without_update)]
        self._start = identity(size + n * times.behind)
        flow = matrix(generator.tolist())
        self._between = Timeline(
            times,
            lambda dt: _BallMap((number(times.exact_seconds(dt)) * flow).exp()),
            *(_BallMap(matrix(np.vstack(rows).tolist())) for rows in occurrences),
        ).between

    def period(self, slot: int, is_delivered: bool) -> IntervalMatrix:
        """Return the map of the state, in units of its own, from one transmission to the next.

        The state is (x, x_c, u, w) with the x of the transmissions before whose updates are on their way.
        Updates are used without a limit of time.

        Args:
            slot: number of the first transmission, modulo the number of slots.
            is_delivered: whether an update arrives before the next one.

        Raises:
            OverflowError: an entry is beyond double precision.
        """
        with ctx.workprec(_BITS):
            return enclosing(self._period(slot, is_delivered))

    def _period(self, slot: int, is_delivered: bool) -> arb_mat:
        begin, state, times = slot * self.times.period, self._start, self.times
        end, sent = begin + times.period, [rows_of(state, part) for part in (self._x, *self._older)]
        loop, arrival = rows_of(state, self._loop), begin
        if is_delivered:
            arrival += times.delay
            loop = self._between(begin, arrival).M * loop
            updated = (number(times.exact_seconds(times.whole_delay)) * self._H).exp() * sent[-1]
            loop = stack([rows_of(loop, self._x), updated, rows_of(loop, self._inputs)])
        return stack([self._between(arrival, end).M * loop, *sent[:-1]])

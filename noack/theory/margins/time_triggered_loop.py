"""The loop of a time-triggered sensor between two deliveries, as a linear map without rounding.

Every T the sensor transmits x. The loop is that of the processes, with no step late:

* at kh the plant, ẋ = Ax + Bu, replaces its input u by the newest actuation w that it has received;
* at its ticks φ, φ + τ, … the controller sends w = K x_c; it arrives at once, after a step of the
  plant at the same time;
* a tick at least Θ after the time of the newest update sends w = 0 instead, or w once more;
* between updates ẋ_c = H x_c; an update of time t_k that arrives at t_k + d sets x_c to
  e^{Hd} x(t_k). At one time, the order is: step of the plant, transmission, arrival, tick.

A delivered update removes all knowledge of older ones. So the state of the loop just after the
delivery, if d = 0, is z = (x, u): x_c = x and w = u there. If 0 < d < T, z is the state at the
time of the transmission, (x, x_c); there u is K e^{−Hδ} x_c for the last tick, δ ago, unless there
may be no tick since the last arrival, or Θ is finite; then z = (x, x_c, u), and the map depends on
how much longer x_c may be used.
"""

import math
from collections.abc import Callable
from functools import cache, reduce
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from noack.core.clock import NEVER_NS
from noack.core.linear_systems import Matrix, balancing_exponents
from noack.theory.margins.exact_matrices import FixedPointMatrix, IntervalMatrix, exponential, fixed, stacked


class LoopTimes(NamedTuple):
    """The times of a time-triggered loop, in nanoseconds."""

    step_ns: int
    """h, of the plant."""
    tick_ns: int
    """τ, of the controller."""
    phase_ns: int
    """φ, of its first tick; below τ."""
    period_ns: int
    """T, between two transmissions; a multiple of h."""
    delay_ns: int
    """d, of an update; below T."""
    timeout_ns: int = NEVER_NS
    """Θ, from the time of the newest update on."""
    holds_input: bool = False
    """Whether w is then sent once more; else it is 0."""

    def usable_ns(self, periods: int, most_ns: int) -> int:
        """Return how much longer, up to some time, an update is used that is some periods old."""
        return min(max(self.timeout_ns - periods * self.period_ns, 0), most_ns)

    @property
    def slots(self) -> int:
        """Number of transmissions after which their times repeat, relative to the ticks."""
        cycle_ns = math.lcm(self.step_ns, self.tick_ns)
        return cycle_ns // math.gcd(cycle_ns, self.period_ns)

    def since_tick_ns(self, t_ns: int) -> int:
        """Time from the last tick before ``t_ns`` to ``t_ns``, above 0."""
        return (t_ns - self.phase_ns - 1) % self.tick_ns + 1

    def occurrences(self, from_ns: int, until_ns: int) -> list[tuple[int, bool]]:
        """Return the times of ticks (True) and of the plant's steps (False) in their order.

        A tick at the end and a step at the start are excluded.
        """
        first = -(-(from_ns - self.phase_ns) // self.tick_ns)
        ticks = range(first * self.tick_ns + self.phase_ns, until_ns, self.tick_ns)
        steps = range((from_ns // self.step_ns + 1) * self.step_ns, until_ns + 1, self.step_ns)
        return sorted([(t_ns, False) for t_ns in steps] + [(t_ns, True) for t_ns in ticks])


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
        flow: the map over some nanoseconds between steps and ticks.
        latch: the map of a step of the plant.
        tick: the map of a tick of the controller.
        late_tick: the map of a tick when no update is new enough.
    """

    def __init__(
        self, times: LoopTimes, flow: Callable[[int], _Map], latch: _Map, tick: _Map, late_tick: _Map
    ) -> None:
        self._times, self._flow, self._latch = times, cache(flow), latch
        self._ticks = tick, late_tick
        self._cycle_ns = math.lcm(times.step_ns, times.tick_ns)
        self._advance = cache(self._advance_from_cycle)

    def between(self, from_ns: int, until_ns: int, timeout_ns: int = NEVER_NS) -> _Map:
        """Return the map between two times; a tick at the end is excluded, and a step at the start.

        From ``timeout_ns`` on the ticks are late.
        """
        split_ns = min(max(timeout_ns, from_ns), until_ns)
        in_time = self._advance(from_ns % self._cycle_ns, split_ns - from_ns, False)
        if split_ns == until_ns:
            return in_time
        return in_time.then(self._advance(split_ns % self._cycle_ns, until_ns - split_ns, True))

    def _advance_from_cycle(self, from_ns: int, duration_ns: int, is_late: bool) -> _Map:
        cycles, rest_ns = divmod(duration_ns, self._cycle_ns)
        last_part = self._occurrences(from_ns, from_ns + rest_ns, is_late)
        if not cycles:
            return last_part
        return repeated(self._occurrences(from_ns, from_ns + self._cycle_ns, is_late), cycles).then(last_part)

    def _occurrences(self, from_ns: int, until_ns: int, is_late: bool) -> _Map:
        parts, now_ns = list[_Map](), from_ns
        for t_ns, is_tick in self._times.occurrences(from_ns, until_ns):
            parts += [self._flow(t_ns - now_ns), self._ticks[is_late] if is_tick else self._latch]
            now_ns = t_ns
        return reduce(lambda first, later: first.then(later), [*parts, self._flow(until_ns - now_ns)])


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
        self.times, self._H = times, H
        # The state of the loop is (x, x_c, u, w).
        size = 2 * (n + m)
        generator = np.zeros((size, size))
        generator[:n, :n], generator[n : 2 * n, n : 2 * n] = A, H
        generator[:n, 2 * n : 2 * n + m] = B
        x, x_c, u, w = np.split(np.eye(size), [n, 2 * n, 2 * n + m])
        self._x, self._x_c, self._K = slice(n), slice(n, 2 * n), fixed(K)
        self._inputs = slice(2 * n, size)
        without_update = w if times.holds_input else 0 * w
        occurrences = [(x, x_c, w, w), (x, x_c, u, K @ x_c), (x, x_c, u, without_update)]
        self._start = fixed(np.eye(size))
        self._between = Timeline(
            times, lambda dt_ns: exponential(generator, dt_ns), *(fixed(np.vstack(o)) for o in occurrences)
        ).between
        self._states: dict[tuple[int, int], list[FixedPointMatrix]] = {}
        """States by slot and use of x_c: (x, x_c, u, w) after 1, 2, … periods, as functions of z."""
        since_ns = [times.since_tick_ns(k * times.period_ns) for k in range(times.slots)]
        follows = max(since_ns) <= times.period_ns - times.delay_ns and times.timeout_ns == NEVER_NS
        if times.delay_ns == 0:
            self._kept = [*range(n), *range(2 * n, 2 * n + m)]  # x, u
        else:
            self._kept = [*range(2 * n if follows else 2 * n + m)]  # x, x_c and perhaps u
        self.dimension = len(self._kept)
        rows = np.vstack([of_x, of_x, of_u, of_u])[self._kept]
        self._given_units = rows.T - rows

    def map(self, slot: int, usable_ns: int, losses: int) -> IntervalMatrix:
        """Return the map of z from a delivered update to the next one.

        Args:
            slot: number of the first update, modulo the number of slots.
            usable_ns: how long the update before it is used after its transmission, up to d.
            losses: number of lost updates between the two.
        """
        return (
            self._state_after(slot, usable_ns, losses).rows(self._kept).interval().scaled(self._given_units)
        )

    def period(self, slot: int, is_delivered: bool) -> IntervalMatrix:
        """Return the map of (x, x_c, u, w), in units of its own, from one transmission to the next.

        Updates are used without a limit of time.

        Args:
            slot: number of the first transmission, modulo the number of slots.
            is_delivered: whether its update arrives.

        Raises:
            OverflowError: an entry is beyond double precision.
        """
        from_ns = slot * self.times.period_ns
        if is_delivered:
            return self._updated(self._start, from_ns, NEVER_NS, NEVER_NS).interval()
        return self._between(from_ns, from_ns + self.times.period_ns).interval()

    def _state_after(self, slot: int, usable_ns: int, losses: int) -> FixedPointMatrix:
        period_ns = self.times.period_ns
        timeout_ns = slot * period_ns + self.times.timeout_ns
        states = self._states.setdefault((slot, usable_ns), [])
        while len(states) <= losses:
            from_ns = (slot + len(states)) * period_ns
            if states:
                states.append(self._between(from_ns, from_ns + period_ns, timeout_ns) @ states[-1])
            else:
                state = self._state(from_ns)
                states.append(self._updated(state, from_ns, from_ns + usable_ns, timeout_ns))
        return states[losses]

    def _updated(
        self, state: FixedPointMatrix, from_ns: int, old_timeout_ns: int, timeout_ns: int
    ) -> FixedPointMatrix:
        """Return the state a period after the transmission of a delivered update."""
        until_ns = from_ns + self.times.period_ns
        # Until the update arrives, x_c is that of older ones.
        sent, arrival_ns = state.rows(self._x), from_ns + self.times.delay_ns
        state = self._between(from_ns, arrival_ns, old_timeout_ns) @ state
        updated = exponential(self._H, self.times.delay_ns) @ sent
        state = stacked(state.rows(self._x), updated, state.rows(self._inputs))
        return self._between(arrival_ns, until_ns, timeout_ns) @ state

    def _state(self, t_ns: int) -> FixedPointMatrix:
        """Return (x, x_c, u, w) as a function of z at a transmission."""
        z, n = fixed(np.eye(self.dimension)), self._x.stop
        if self.times.delay_ns == 0:
            x, u = z.rows(slice(n)), z.rows(slice(n, None))
            return stacked(x, x, u, u)
        if self.dimension > 2 * n:
            return stacked(z, z.rows(slice(2 * n, None)))
        u = self._K @ exponential(-self._H, self.times.since_tick_ns(t_ns)) @ z.rows(self._x_c)
        return stacked(z, u, u)

"""The times of a scenario's schedule: steps of the plant, measurements, ticks of the controller.

Steps are at multiples of their period T, measurements at every ``measure_every``-th step, ticks at
multiples of theirs from the phase on. At equal times a step comes before arrivals. An update takes
effect at the first step with the input of a tick at or after its arrival. This input acts until the
step after the last one that has it. Up to L steps, and the network's delay, may be added to this.

noack's times are whole nanoseconds: if a period is none, step k is at the nearest one to kT, so that
times between steps differ by 1 ns, and their order may, too.
"""

from fractions import Fraction
from math import ceil, floor, gcd

from flint import fmpq

from noack_check.loop import Times

NS_PER_S = 10**9
_ROUNDED_NS = 2
"""More than two times of steps differ from exact ones, together."""
_WHOLE = 1e-12
"""A period that differs by less from a whole number of nanoseconds is one, relatively."""
_LONGEST_ROUNDED_NS = 10**11
_MOST_PARTS = 100_000
"""Largest denominator of a period in nanoseconds."""


def fraction(value: float) -> Fraction:
    """Return the simplest fraction that a positive float can mean: 1/30 for 0.03333333333333333."""
    exact, limit = Fraction(value), 1
    while abs((meant := exact.limit_denominator(limit)) - exact) > 1e-15 * exact:
        limit *= 10
    return meant


def nanoseconds(seconds: float) -> int:
    """Return the whole nanoseconds of a time, rounded down."""
    return int(fraction(seconds) * NS_PER_S) if seconds else 0


def nearest_ns(seconds: float) -> int:
    """Return the nearest whole nanoseconds of a time, as the machines have it."""
    return round(seconds * NS_PER_S)


def period_ns(rate_hz: float) -> Fraction:
    """Return the period of a rate in nanoseconds."""
    exact = NS_PER_S / fraction(rate_hz)
    whole = max((2 * exact + 1) // 2, 1)
    if abs(whole - exact) <= _WHOLE * min(float(exact), _LONGEST_ROUNDED_NS):
        return Fraction(whole)
    return exact.limit_denominator(min(_MOST_PARTS, int(exact)))


class Schedule:
    """The schedule of a loop, in nanoseconds.

    Args:
        rate_hz: steps of the plant per second.
        measure_every: steps per measurement.
        tick_hz: ticks of the controller per second.
        phase: of the ticks, in their periods.
        late_periods: L, steps by which updates and inputs may be late.
        network_delay_s: largest delay of an update in the network.
    """

    def __init__(
        self,
        rate_hz: float,
        measure_every: int,
        tick_hz: float,
        phase: float,
        late_periods: int,
        network_delay_s: float,
    ) -> None:
        self.step, self.tick = period_ns(rate_hz), period_ns(tick_hz)
        self.sample = self.step * measure_every
        self.is_whole = self.step.denominator == self.tick.denominator == 1
        self._rounded = 0 if self.is_whole else _ROUNDED_NS
        self._late = late_periods * ceil(self.step)
        self._phase = fraction(phase) * self.tick if phase else Fraction(0)
        if self.tick.denominator == 1:
            self.phase = round(phase * int(self.tick))
        else:
            self.phase = ceil(self._phase)
        if self.is_whole:
            self._in_flight = self._late + ceil(network_delay_s * NS_PER_S)
        else:
            self._in_flight = floor(late_periods * self.step) + nanoseconds(network_delay_s)

    @property
    def exact_phase(self) -> Fraction:
        """The time of the first tick; without rounding, if the periods are no whole numbers."""
        return Fraction(self.phase) if self.is_whole else self._phase

    @property
    def times(self) -> Times:
        """The times that the statements need."""
        longest = ceil(self.sample)
        shortest = longest if self.is_whole else floor(self.sample)
        delay, first = self._next_step(self._wait()), self._next_step(self.phase)
        start = max(first + self._late, delay) if self._in_flight else first
        age = self._oldest_tick() + ceil(self.step) + self._late
        return Times(*(fmpq(t, NS_PER_S) for t in (longest, shortest, delay, age, start)))

    def between_events(self, due_ns: int) -> tuple[fmpq, fmpq]:
        """Return the least and the largest time from an event to the first measurement that late.

        Measurement k is at round(kT); what follows depends on k modulo the denominator of T.
        """
        T = self.sample
        found = set()
        for k in range(T.denominator):
            start = _rounded(k * T)
            later = k + max(floor((due_ns - 1) / T), 1)
            while _rounded(later * T) - start < due_ns:
                later += 1
            found.add(_rounded(later * T) - start)
        return fmpq(min(found), NS_PER_S), fmpq(max(found), NS_PER_S)

    def _oldest_tick(self) -> int:
        """Return the largest age of the newest tick at a step; what it lacks of a tick's period is kept."""
        newest = self.tick - self.phase % _common(self.step, self.tick) + self._rounded
        return ceil(newest + self.tick - floor(self.tick))

    def _wait(self) -> Fraction:
        """Return the longest time from an event to the tick that uses its update."""
        common = _common(self.sample, self.tick)
        rest = self.phase % common
        if not self._in_flight:
            return self.tick - common + rest
        wait = self._in_flight + self.tick - 1  # it may just miss a tick
        if self.is_whole:
            return wait
        return (ceil((wait + 1 - rest) / common) - 1) * common + rest  # the largest possible one below

    def _next_step(self, t: Fraction | int) -> int:
        """Return a time up to which the next step after a time has come."""
        return ceil(((t + self._rounded) // self.step + 1) * self.step) + self._rounded


def _rounded(t: Fraction) -> int:
    """Return the nearest whole number, halves up."""
    return floor(t + Fraction(1, 2))


def _common(first: Fraction, second: Fraction) -> Fraction:
    """Return the largest time of which both are multiples."""
    unit = first.denominator * second.denominator
    return Fraction(gcd(int(first * unit), int(second * unit)), unit)

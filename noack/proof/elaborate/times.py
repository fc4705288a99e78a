"""The times of a scenario's schedule: steps of the plant, measurements, ticks of the controller.

Steps are at multiples of their period T, measurements at every ``measure_every``-th step, ticks at
multiples of theirs from the phase on. At equal times a step comes before arrivals. An update takes
effect at the first step with the input of a tick at or after its arrival. This input acts until the
step after the last one that has it. Up to L steps, and the network's delay, may be added to this.

Where inputs cross the network, the plant uses those of the newest tick of which they have arrived. The next
ones that arrive are at most a *gap* later than without losses and delays: as many periods of the ticks as
inputs may be lost one after the other, and their delay. A tick sends inputs for its own time and for some of
the following ticks; the plant applies the last one whose time has come.

noack's times are whole nanoseconds: if a period is none, step k is at the nearest one to kT, so that
times between steps differ by 1 ns, and their order may, too.
"""

from fractions import Fraction
from math import ceil, floor, gcd

from flint import fmpq

from noack.proof.elaborate.loop import Times

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


class ScenarioSchedule:
    """The schedule of a loop, in nanoseconds.

    Args:
        rate_hz: steps of the plant per second.
        measure_every: steps per measurement.
        tick_hz: ticks of the controller per second.
        phase: of the ticks, in their periods.
        late_periods: L, steps by which updates and inputs may be late.
        network_delay_s: largest delay of an update in the network.
        lost_inputs: of so many successive ticks all inputs may be lost in the network.
        input_delay_ns: the delay of inputs in the network.
        predictions: of so many ticks, its own one and those after it, a tick sends the inputs.
    """

    def __init__(
        self,
        rate_hz: float,
        measure_every: int,
        tick_hz: float,
        phase: float,
        late_periods: int,
        network_delay_s: float,
        lost_inputs: int = 0,
        input_delay_ns: Fraction = Fraction(0),
        predictions: int = 1,
    ) -> None:
        self.step, self.tick = period_ns(rate_hz), period_ns(tick_hz)
        self.sample = self.step * measure_every
        self.is_whole = self.step.denominator == self.tick.denominator == 1
        self._rounded = 0 if self.is_whole else _ROUNDED_NS
        self._late = late_periods * ceil(self.step)
        self._gap = lost_inputs * ceil(self.tick) + ceil(input_delay_ns)
        self._predicted = floor(predictions * self.tick) - self.tick
        self.last_input = fmpq((predictions - 1) * ceil(self.tick), NS_PER_S)
        """So long after a tick its last input is due, in s."""
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
        delay, first = (self._next_step(t + self._gap) for t in (self._wait(), self.phase))
        start = max(first + self._late, delay) if self._in_flight else first
        oldest = self._oldest_tick()
        age = ceil(max(min(oldest, self.tick + self._rounded), oldest - self._predicted))
        age += ceil(self.step) + self._late
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

    @property
    def oldest_input(self) -> fmpq:
        """The largest age that the newest tick of which inputs have arrived may have, in s, until a step."""
        return fmpq(ceil(self._oldest_tick()) + ceil(self.step) + self._late, NS_PER_S)

    def _oldest_tick(self) -> Fraction:
        """Return the largest age of the newest tick of which inputs have arrived at a step."""
        if self._gap % self.tick:  # they may just have missed a step
            return self._gap + self.tick + self._rounded
        return self._gap + self.tick - self.phase % _common(self.step, self.tick) + self._rounded

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

"""The times of a loop's schedule: steps of the plant, measurements, ticks of the controller.

Steps are at multiples of their period T, measurements at every so-manieth step, ticks at multiples of their
period from the phase on. At equal times a step comes before arrivals. An update takes effect at the first
step after the first tick at or after its arrival. The input of a tick acts until the step after the last one
that has it. Up to L steps, and the network's delay, may be added to this.

Where inputs cross the network, the plant uses those of the newest tick of which they have arrived. The next
ones that arrive are at most a *gap* later than without losses and delays: as many periods of the ticks as
inputs may be lost one after the other, and their delay. A tick sends inputs for its own time and for some of
the following ticks; the plant applies the last one whose time has come.

Machines use whole nanoseconds: if a period is none, step k is at the nearest one to kT (see
:mod:`netem.core.periods`), so that times between steps differ by 1 ns, and their order may, too. Periods are
exact here, and each result covers this rounding.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

from netem.core.clock import NS_PER_S
from netem.core.periods import Period, simplest_fraction, whole_ns

_ROUNDED_NS = 2
"""More than two times of steps differ from exact ones, together."""


def first_tick_ns(phase: float, tick: Period) -> int:
    """Return the time of the first tick, whose phase is a share of its period.

    It is rounded up if machines round the period, so that it is not before a step at its time.
    """
    if tick.is_whole:
        return round(phase * tick.longest_ns)
    return math.ceil(simplest_fraction(phase) * tick.exact)


class ScheduleBounds(NamedTuple):
    """What a schedule allows at most, in ns. Without losses, delays and rounding it happens, too."""

    sampling_ns: int
    """The longest time between two measurements."""
    least_sampling_ns: int
    """The shortest time between two measurements."""
    delay_ns: int
    """The longest time from a measurement until an update of it that is delivered takes effect."""
    age_ns: int
    """The largest age of the input that acts: so long before the time is that for which it was computed."""
    start_ns: int
    """The time until the first input acts."""


@dataclass(frozen=True)
class LoopSchedule:
    """The schedule of a loop."""

    step: Period
    """Of the plant."""
    measure_every: int
    """Steps per measurement."""
    tick: Period
    """Of the controller."""
    phase: float
    """Of its first tick, as a share of its period."""
    late_periods: int = 0
    """L, steps by which updates and inputs may be late."""
    network_delay_s: float = 0.0
    """The longest delay of an update in the network."""
    input_gap_ns: int = 0
    """The gap of inputs: by so much losses and delays may hold up the newest ones."""
    predictions: int = 1
    """Of so many ticks, its own one and those after it, a tick sends the inputs."""

    @property
    def sample(self) -> Period:
        """The time between two measurements."""
        return self.step.times(self.measure_every)

    @property
    def is_whole(self) -> bool:
        """Whether all periods are whole numbers of nanoseconds."""
        return self.step.is_whole and self.tick.is_whole

    @property
    def phase_ns(self) -> int:
        """The time of the first tick."""
        return first_tick_ns(self.phase, self.tick)

    @property
    def exact_phase(self) -> Fraction:
        """The same time without rounding, if machines round periods."""
        return Fraction(self.phase_ns) if self.is_whole else simplest_fraction(self.phase) * self.tick.exact

    @property
    def in_flight_ns(self) -> int:
        """The longest time for which an update may be on its way: the network's delay, and L steps."""
        if self.is_whole:
            return self._late_ns + math.ceil(self.network_delay_s * NS_PER_S)
        # Rounded down, whole steps take as many.
        return math.floor(self.late_periods * self.step.exact) + whole_ns(self.network_delay_s)

    @property
    def bounds(self) -> ScheduleBounds:
        """What the schedule allows at most."""
        gap_ns, oldest_ns = self.input_gap_ns, self._oldest_tick_ns
        delay_ns, first_ns = (self._next_step_ns(t + gap_ns) for t in (self._wait_ns, self.phase_ns))
        # Of predicted inputs, the plant applies the one whose time has come.
        further_ns = self.predicted_ns - self.tick.exact
        age_ns = max(min(oldest_ns, self.tick.exact + self._rounded_ns), oldest_ns - further_ns)
        return ScheduleBounds(
            self.sample.longest_ns,
            self.sample.lengths_ns[0],
            delay_ns,
            self._until_next_step_ns(age_ns),
            max(first_ns + self._late_ns, delay_ns) if self.in_flight_ns else first_ns,
        )

    @property
    def oldest_inputs_ns(self) -> int:
        """The largest age, until a step, of the newest tick of which inputs have arrived."""
        return self._until_next_step_ns(self._oldest_tick_ns)

    @property
    def predicted_ns(self) -> int:
        """The time for which a tick sends inputs."""
        return math.floor(self.predictions * self.tick.exact)

    @property
    def last_prediction_ns(self) -> int:
        """So long after a tick its last input is due."""
        return (self.predictions - 1) * self.tick.longest_ns

    def between_events_ns(self, due_ns: int) -> tuple[int, int]:
        """Return the least and the largest time from an event to the first measurement that late.

        What follows a measurement depends on its number modulo the denominator of the period.
        """
        sample, found = self.sample, set()
        for k in range(sample.exact.denominator):
            later = k + max(math.floor((due_ns - 1) / sample.exact), 1)
            while sample.time_ns(later) - sample.time_ns(k) < due_ns:
                later += 1
            found.add(sample.time_ns(later) - sample.time_ns(k))
        return min(found), max(found)

    @property
    def _rounded_ns(self) -> int:
        """By so much times of steps, together, differ from exact ones; their order may, too."""
        return 0 if self.is_whole else _ROUNDED_NS

    @property
    def _late_ns(self) -> int:
        return self.late_periods * self.step.longest_ns

    @property
    def _wait_ns(self) -> Fraction | int:
        """The longest time from an event to the tick that uses its update."""
        tick, common = self.tick.exact, _common(self.sample.exact, self.tick.exact)
        rest = self.phase_ns % common
        if not self.in_flight_ns:  # all times from 0 to below a period occur that have this rest
            return tick - common + rest
        wait = self.in_flight_ns + tick - 1  # it may just miss a tick
        if self.is_whole:
            return wait
        return (math.ceil((wait + 1 - rest) / common) - 1) * common + rest  # the largest possible one below

    @property
    def _oldest_tick_ns(self) -> Fraction:
        """The largest age at a step of the newest tick of which inputs have arrived.

        Of the newest tick itself it is above 0 and at most a period, and −phase modulo the common time.
        """
        oldest = self.input_gap_ns + self.tick.exact + self._rounded_ns
        if self.input_gap_ns % self.tick.exact:  # the inputs may just have missed a step
            return oldest
        return oldest - self.phase_ns % _common(self.step.exact, self.tick.exact)

    def _until_next_step_ns(self, age_ns: Fraction) -> int:
        """Return an age at a step as it is until the next one, which may be late."""
        return math.ceil(age_ns) + self.step.longest_ns + self._late_ns

    def _next_step_ns(self, t_ns: Fraction | int) -> int:
        """Return a time up to which the next step after a time has come."""
        step, rounded = self.step.exact, self._rounded_ns
        return math.ceil(((t_ns + rounded) // step + 1) * step) + rounded


def _common(first: Fraction, second: Fraction) -> Fraction:
    """Return the largest time of which both are multiples."""
    unit = first.denominator * second.denominator
    return Fraction(math.gcd(int(first * unit), int(second * unit)), unit)

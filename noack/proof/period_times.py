"""The times of a loop that transmits at each period, in whole parts of a nanosecond."""

import math
from fractions import Fraction
from typing import NamedTuple

from netem.core.clock import NS_PER_S
from noack.scenario.arrival_ties import LATENCY_NS

NEVER = 10**60
"""Later than all times, in any unit."""


class ArrivalAtTransmissionError(ValueError):
    """An update may arrive in the period before or after, as it arrives near a transmission and a tick."""


class LoopTimes(NamedTuple):
    """The schedule of a time-triggered loop, in parts of a nanosecond: no period is rounded.

    :func:`noack.theory.time_triggered.scenario_times.loop_times` derives it from a scenario's ``Timing``. All
    its times are whole numbers, so that what happens at the same time does so here, too.
    """

    step: int
    """h, of the plant."""
    tick: int
    """τ, of the controller."""
    phase: int
    """φ, of its first tick; below τ."""
    period: int
    """T, between two transmissions; a multiple of h."""
    delay: int
    """d, of an update, or what is left of it after whole periods; below T."""
    timeout: int = NEVER
    """Θ, from the time of the newest update on."""
    holds_input: bool = False
    """Whether w is then sent once more; else it is 0."""
    parts: int = 1
    """Number of parts of a nanosecond."""
    behind: int = 0
    """⌊d/T⌋: so many further transmissions happen while an update is on its way."""

    def seconds(self, duration: int) -> float:
        """Return a time in seconds."""
        return duration / (self.parts * NS_PER_S)

    def exact_seconds(self, duration: int) -> Fraction:
        """Return a time in seconds, without rounding."""
        return Fraction(duration, self.parts * NS_PER_S)

    def usable(self, periods: int, most: int) -> int:
        """Return how much longer, up to some time, an update is used that is some periods old."""
        return min(max(self.timeout - periods * self.period, 0), most)

    @property
    def whole_delay(self) -> int:
        """d, of an update."""
        return self.behind * self.period + self.delay

    @property
    def slots(self) -> int:
        """Number of transmissions after which their times repeat, relative to the ticks."""
        cycle = math.lcm(self.step, self.tick)
        return cycle // math.gcd(cycle, self.period)

    def occurrences(self, begin: int, end: int) -> list[tuple[int, bool]]:
        """Return the times of ticks (True) and of the plant's steps (False) in their order.

        A tick at the end and a step at the start are excluded.
        """
        first = -(-(begin - self.phase) // self.tick)
        ticks = range(first * self.tick + self.phase, end, self.tick)
        steps = range((begin // self.step + 1) * self.step, end + 1, self.step)
        return sorted([(t, False) for t in steps] + [(t, True) for t in ticks])

    def arrivals(self, slot: int) -> list[int]:
        """Return how long after a transmission an update may arrive, first the nominal time.

        What nominally arrives within the latency of a live tick, before or after it, may act at this tick or
        at the next one. An arrival at a tick is before it. Whole periods of the delay are left out.

        Raises:
            ArrivalAtTransmissionError: one of them is in the period before or after.
        """
        begin, near = slot * self.period, LATENCY_NS * self.parts
        arrival = begin + self.delay
        before = (arrival - self.phase) // self.tick * self.tick + self.phase
        found = [self.delay]
        for tick in (before, before + self.tick):
            other = (tick if tick < arrival else tick + 1) - begin
            if abs(tick - arrival) > near or (other < 0 and self.behind == 0):
                continue
            if not 0 <= other <= self.period:
                raise ArrivalAtTransmissionError
            found.append(other)
        return found

    @property
    def latest(self) -> int:
        """The longest time from a transmission to an arrival, without whole periods."""
        return max(max(self.arrivals(slot)) for slot in range(self.slots))

    @property
    def has_ties(self) -> bool:
        """Whether an update may act at one of two ticks."""
        return any(len(self.arrivals(slot)) > 1 for slot in range(self.slots))

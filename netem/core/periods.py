"""Periods that are no whole number of nanoseconds: 1/30 s, and their steps on the grid of times.

Times are whole nanoseconds. Step k of a period T is at kT, rounded to the nearest one, halves up: no
rounding error adds up. A delay that is rounded down then takes as many steps as in exact arithmetic:
⌊dT⌋ + round(kT) ≤ round((k + d)T) for whole k and d.
"""

import math
from fractions import Fraction
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from netem.core.clock import NS_PER_S

_ROUNDING = 1e-15
"""Largest relative difference between a number and the fraction that is meant by it."""


def simplest_fraction(number: float) -> Fraction:
    """Return the fraction that is meant by a number of at least 0: 1/30 by 0.03333333333333333."""
    exact, limit = Fraction(number), 1
    while abs((meant := exact.limit_denominator(limit)) - exact) > _ROUNDING * exact:
        limit *= 10
    return meant


def exact_ns(seconds: float) -> Fraction:
    """Return the nanoseconds that are meant by a number of seconds of at least 0."""
    return simplest_fraction(seconds) * NS_PER_S


def whole_ns(seconds: float) -> int:
    """Return the nanoseconds that are meant by a time of at least 0 s, rounded down."""
    return int(exact_ns(seconds))


def nearest_ns(time_ns: Fraction) -> int:
    """Return the nearest whole nanosecond, halves up."""
    return (2 * time_ns + 1) // 2


MOST_PARTS = 100_000
"""Largest denominator of a period in nanoseconds; the core's integers then do not overflow."""


class Period:
    """A period T, a fraction of nanoseconds; step k from time 0 on is at the nearest one to kT."""

    def __init__(self, exact: Fraction | int) -> None:
        self.exact = Fraction(exact)
        """T."""

    def __eq__(self, other: object) -> bool:
        """Whether it is the same period."""
        return isinstance(other, Period) and self.exact == other.exact

    def __hash__(self) -> int:
        """The hash of T."""
        return hash(self.exact)

    def __repr__(self) -> str:
        """The period in nanoseconds."""
        return f"Period({self.exact})"

    @cached_property
    def core(self) -> tuple[int, int, int]:
        """The core's ``noack_period``: whole nanoseconds, and parts of one."""
        whole_ns, part = divmod(self.exact.numerator, self.exact.denominator)
        return whole_ns, part, self.exact.denominator

    @property
    def seconds(self) -> float:
        """T in seconds, rounded."""
        return float(self.exact / NS_PER_S)

    @property
    def is_whole(self) -> bool:
        """Whether it is a whole number of nanoseconds."""
        return self.exact.denominator == 1

    @property
    def lengths_ns(self) -> tuple[int, ...]:
        """The times between two steps, ascending."""
        return tuple(dict.fromkeys((math.floor(self.exact), math.ceil(self.exact))))

    @property
    def longest_ns(self) -> int:
        """The longest time between two steps."""
        return self.lengths_ns[-1]

    def time_ns(self, step: int) -> int:
        """Return the time of a step."""
        return nearest_ns(step * self.exact)

    def times_ns(self, steps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the times of k steps, (k,)."""
        whole_ns, part, parts = self.core
        return steps * whole_ns + (2 * steps * part + parts) // (2 * parts)

    def last_until(self, t_ns: int) -> int:
        """Return the last step that is not after a time, which is not negative."""
        return math.ceil((t_ns + Fraction(1, 2)) / self.exact) - 1

    def times(self, count: int) -> "Period":
        """Return the period of every so-manieth step."""
        return Period(count * self.exact)


RATE_ROUNDING = 1e-12
"""Largest relative difference between a rate and that of its steps: 10 µs after 1e7 s."""
_LONGEST_ROUNDED_NS = 10**11
"""A longer period is not taken as a whole number of nanoseconds because of this difference."""


@cache
def period_of(rate_hz: float) -> Period:
    """Return the period of a rate: of 30 Hz 10⁹/30 ns."""
    exact = NS_PER_S / simplest_fraction(rate_hz)
    whole = max(nearest_ns(exact), 1)
    if abs(whole - exact) <= RATE_ROUNDING * min(float(exact), _LONGEST_ROUNDED_NS):
        return Period(whole)
    return Period(exact.limit_denominator(min(MOST_PARTS, int(exact))))


ANY_PERIOD = Period(1)
"""The period of the inputs of a plant that predicts none."""

"""Periods that are no whole number of nanoseconds: 1/30 s, and their steps on the grid of times.

Times are whole nanoseconds. Step k of a period T is at kT, rounded to the nearest one, halves up: no
rounding error adds up. A delay that is rounded down then takes as many steps as in exact arithmetic:
⌊dT⌋ + round(kT) ≤ round((k + d)T) for whole k and d.
"""

from fractions import Fraction

from noack.core.clock import NS_PER_S

_ROUNDING = 1e-15
"""Largest relative difference between a number and the fraction that is meant by it."""


def simplest_fraction(number: float) -> Fraction:
    """Return the fraction that is meant by a positive number: 1/30 by 0.03333333333333333."""
    exact, limit = Fraction(number), 1
    while abs((meant := exact.limit_denominator(limit)) - exact) > _ROUNDING * exact:
        limit *= 10
    return meant


def exact_ns(seconds: float) -> Fraction:
    """Return the nanoseconds that are meant by a positive number of seconds."""
    return simplest_fraction(seconds) * NS_PER_S


def nearest_ns(time_ns: Fraction) -> int:
    """Return the nearest whole nanosecond, halves up."""
    return (2 * time_ns + 1) // 2

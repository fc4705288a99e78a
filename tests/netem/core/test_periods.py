"""Periods that are no whole number of nanoseconds: fractions that are meant, times without drift."""

import math
from fractions import Fraction

import pytest

from netem.core.periods import exact_ns, nearest_ns, simplest_fraction

RATES = (3, 7, 30, 60, 90, 120, 144, 240, 500, 1000, 64_000, Fraction(30_000, 1001), Fraction(1, 3))


@pytest.mark.parametrize("rate", RATES)
def test_a_float_means_the_simplest_fraction(rate: Fraction) -> None:
    assert simplest_fraction(float(rate)) == rate
    assert simplest_fraction(1 / float(rate)) == 1 / Fraction(rate)
    assert simplest_fraction(math.nextafter(float(rate), 0)) == rate


@pytest.mark.parametrize("number", [math.pi, 0.1234567890123456, 1e-6, 1e15 / 3, 2.0**52 + 1])
def test_any_other_number_is_kept_within_its_rounding(number: float) -> None:
    assert float(simplest_fraction(number)) == pytest.approx(number, rel=1e-15)


def test_a_sum_that_is_rounded_means_its_decimals() -> None:
    assert exact_ns(0.1 + 0.2) == 300_000_000


@pytest.mark.parametrize("rate", RATES)
def test_delays_that_are_rounded_down_take_their_steps(rate: Fraction) -> None:
    period = 10**9 / Fraction(rate)
    times = [nearest_ns(k * period) for k in range(60)]
    assert all(abs(t_ns - k * period) <= Fraction(1, 2) for k, t_ns in enumerate(times))
    for delay in range(1, 20):
        for k in range(40):
            arrival_ns = times[k] + int(delay * period)
            assert times[k + delay - 1] < arrival_ns <= times[k + delay]

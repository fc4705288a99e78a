"""Intervals of rates and probabilities: against tables, closed forms and simulation."""

import math

import numpy as np
import pytest

from netem.measurement.interval_estimates import binomial_estimate, exponential_estimate, poisson_estimate


@pytest.mark.parametrize(("count", "low", "high"), [(0, 0.0, 3.689), (1, 0.0253, 5.572), (10, 4.795, 18.39)])
def test_poisson_intervals_are_those_of_garwood(count: int, low: float, high: float) -> None:
    """Garwood, Biometrika 28, 1936, and every table since."""
    estimate = poisson_estimate(count, 2.0)
    np.testing.assert_allclose(estimate, [count / 2, low / 2, high / 2], rtol=2e-3)


def test_intervals_of_0_and_of_all_events_are_those_of_the_likelihood() -> None:
    assert binomial_estimate(0, 0) is None
    assert exponential_estimate(0, 3.0) is None
    never, always = binomial_estimate(0, 50), binomial_estimate(50, 50)
    assert never is not None
    assert always is not None
    limit = 1 - math.exp(-1.920729 / 50)  # (1 − p)^50 = e^(−χ²/2)
    assert (never.low, always.high) == (0.0, 1.0)
    assert (never.high, always.low) == pytest.approx((limit, 1 - limit))
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(1000):
        estimate = exponential_estimate(4, rng.exponential(2.0, 4).sum())
        inside.append(estimate is not None and estimate.low <= 2.0 <= estimate.high)
    assert abs(np.mean(inside) - 0.95) < 0.03

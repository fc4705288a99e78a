"""Estimates against closed forms, and the coverage of their intervals."""

import math

import numpy as np
import pytest
from scipy.stats import t as student

from cosim.studies.campaign.metrics import difference, estimate, interval_ranks


def test_the_interval_of_a_mean_is_the_textbooks() -> None:
    values = np.array([1.0, 2.0, 4.0, 9.0])
    found = estimate(values)
    assert found.mean == 4.0
    deviation = math.sqrt(((values - 4.0) ** 2).sum() / 3)
    assert found.halfwidth == pytest.approx(student.ppf(0.975, 3) * deviation / 2, rel=1e-12)
    assert (found.median, found.q05, found.q95, found.largest) == (2.0, 1.0, 9.0, 9.0)


def test_intervals_have_their_nominal_coverage() -> None:
    rng = np.random.default_rng(0)
    trials, of_mean, of_median = 1000, 0, 0
    for _ in range(trials):
        found = estimate(rng.exponential(1.0, 101))
        of_mean += abs(found.mean - 1.0) <= found.halfwidth
        of_median += found.median_low <= math.log(2) <= found.median_high
    # Standard deviation of a share: 0.007. A normal interval of a skewed law covers slightly less.
    assert 0.92 < of_mean / trials < 0.97
    assert 0.94 < of_median / trials < 0.98


@pytest.mark.parametrize("draws", [2, 10])
def test_intervals_of_few_draws_have_their_nominal_coverage(draws: int) -> None:
    """A normal interval of two draws covers the true value in only 70 % of the cases."""
    values = np.random.default_rng(draws).normal(3.0, 2.0, (2000, draws))
    hits = 0
    for row in values:
        found = estimate(row)
        hits += abs(found.mean - 3.0) <= found.halfwidth
    assert abs(hits / len(values) - 0.95) < 0.0195  # four standard deviations of a share


def test_infinite_values_count_for_quantiles_and_not_for_the_mean() -> None:
    found = estimate(np.array([3.0, math.inf, 1.0, math.inf, math.inf]))
    assert (found.draws, found.finite, found.mean) == (5, 2, 2.0)
    assert found.median == found.largest == math.inf
    none = estimate(np.full(3, math.inf))
    assert (none.finite, none.mean, none.halfwidth) == (0, math.inf, math.inf)


def test_too_few_draws_give_no_interval() -> None:
    found = estimate(np.array([1.0]))
    assert found.halfwidth == found.median_high == math.inf
    assert found.median_low == -math.inf
    assert estimate(np.arange(5.0)).median_high == math.inf
    assert estimate(np.arange(6.0)).median_high == 5.0  # 1 − 2 · 2⁻⁶ > 0.95


def test_differences_are_taken_draw_by_draw() -> None:
    reference = np.array([1.0, 5.0, math.inf, math.inf, 2.0])
    values = np.array([2.0, 4.0, math.inf, 3.0, 2.0])
    found = difference(values, reference)
    assert found.estimate.mean == 0.0
    assert found.estimate.finite == 3
    assert (found.larger, found.smaller) == (0.2, 0.4)
    assert found.estimate.q05 == -math.inf
    assert found.estimate.median == 0.0


def test_pairing_narrows_the_interval() -> None:
    rng = np.random.default_rng(1)
    common, noise = rng.normal(0, 10, 500), rng.normal(0.5, 0.1, 500)
    paired = difference(common + noise, common).estimate
    assert paired.halfwidth < 0.02 < estimate(common).halfwidth
    assert abs(paired.mean - 0.5) < 3 * paired.halfwidth


def at_most(j: int, count: int, share: float) -> float:
    """P(Bin(count, share) ≤ j), term by term."""
    return math.fsum(
        math.comb(count, i) * share**i * (1 - share) ** (count - i) for i in range(j + 1)
    )


@pytest.mark.parametrize(("count", "quantile"), [(100, 0.5), (200, 0.9), (400, 0.95)])
def test_ranks_are_the_tightest_with_the_required_confidence(count: int, quantile: float) -> None:
    low, high = interval_ranks(count, quantile)
    # The value of rank r (from 0) is above the quantile if at most r values are below it.
    assert at_most(high, count, quantile) >= 0.975 > at_most(high - 1, count, quantile)
    assert at_most(low, count, quantile) <= 0.025 < at_most(low + 1, count, quantile)

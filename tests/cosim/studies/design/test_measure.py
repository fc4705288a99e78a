"""The limits of a design, and the number of draws that a quantile needs."""

import math

import pytest

from cosim.studies.campaign.draw_statistics import interval_ranks
from cosim.studies.design.candidate_measures import DesignLimits, require_draws
from noack.core.errors import CallerError


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


def test_too_few_draws_for_a_quantile_are_refused_with_the_required_number() -> None:
    with pytest.raises(CallerError, match="--draws: 50 are too few") as caught:
        require_draws(50, 0.95)
    enough = int(str(caught.value).split()[-3])
    require_draws(enough, 0.95)
    assert 1 - 0.95**enough >= 0.975  # P(the largest value exceeds the quantile)


def test_the_largest_excess_over_a_limit_counts() -> None:
    limits = DesignLimits(10.0, 0.95, 0.02, {"state": 4.0, "error": 1.0})
    assert limits.excess(10.0, {"state": 4.0, "error": 1.0}) == 0
    assert limits.excess(20.0, {"state": 5.0, "error": 1.0}) == pytest.approx(0.5)
    assert limits.excess(9.0, {"state": math.inf, "error": 1.0}) == 1
    assert limits.excess(9.0, {}) == 0  # not yet computed

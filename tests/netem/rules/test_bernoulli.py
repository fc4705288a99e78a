from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss


@pytest.mark.parametrize("p", [0.02, 0.3, 0.8])
def test_losses_are_independent_and_have_the_given_rate(
    decide: Any, share_is: Callable[..., None], p: float
) -> None:
    lost = decide([LossOf(loss=BernoulliLoss(probability=p))], 400_000).fates == 1
    share_is(lost, p)
    for lag in (1, 2, 7):
        share_is(lost[lag:] & lost[:-lag], p * p)


@pytest.mark.parametrize("p", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("mansd", [0, 1, 4, 17])
def test_under_a_cap_the_rate_is_the_predicted_one(
    decide: Any, share_is: Callable[..., None], p: float, mansd: int
) -> None:
    """p (1 − pᵐ)/(1 − pᵐ⁺¹): between two deliveries, Σ pᵏ packets are lost, k = 1 … m."""
    loss = LossOf(loss=BernoulliLoss(probability=p))
    decided = decide(LinkSettings(impairments=(loss,), mansd=mansd), 400_000)
    lost = decided.fates == 1
    if mansd == 0:
        assert not lost.any()
        share_is(decided.fates == 2, p)
    else:
        share_is(lost, p * (1 - p**mansd) / (1 - p ** (mansd + 1)))
    # The cap overrides the loss model and does not change its other draws.
    freely = decide([loss], 400_000).fates == 1
    np.testing.assert_array_equal(decided.fates != 0, freely)

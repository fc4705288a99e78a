"""Correlated losses keep their probability; joint probabilities match a closed form."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from noack.impairments.kinds.loss import LossOf
from noack.impairments.loss_models.bernoulli import BernoulliLoss

COUNT = 400_000


def lost(decide: Any, p: float, correlation: float, seed: int = 0) -> Any:
    loss = BernoulliLoss(probability=p, correlation=correlation)
    return decide([LossOf(loss=loss)], COUNT, seed=seed).fates == 1


def both(p: float, correlation: float) -> float:
    """P(z₁ > t, z₂ > t) for bivariate normal z with this correlation, where P(z > t) = p."""
    t = stats.norm.ppf(p)
    normal = stats.multivariate_normal(cov=np.array([[1, correlation], [correlation, 1]]))
    return float(normal.cdf([t, t]))


@pytest.mark.parametrize("p", [0.02, 0.3, 0.8])
@pytest.mark.parametrize("correlation", [0.0, 0.25, 0.7, 0.9])
def test_probability_and_correlation_are_exact(
    decide: Any, share_is: Callable[..., None], p: float, correlation: float
) -> None:
    flags = lost(decide, p, correlation)
    share_is(flags, p)
    for lag in (1, 2, 3):  # AR(1): the latent correlation at lag k is ρᵏ
        share_is(flags[lag:] & flags[:-lag], both(p, correlation**lag))


def test_the_first_datagram_has_the_same_loss_probability(decide: Any) -> None:
    """The latent process starts in its stationary distribution (average over many flows)."""
    loss = LossOf(loss=BernoulliLoss(probability=0.2, correlation=0.95))
    flows = np.tile(np.arange(20_000), 2)
    fates = decide([loss], len(flows), flows=flows).fates.reshape(2, -1)
    for of_flow in fates:
        assert abs(np.mean(of_flow == 1) - 0.2) < 5 * np.sqrt(0.2 * 0.8 / 20_000)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.999])
def test_probabilities_0_and_1_are_exact(decide: Any, correlation: float) -> None:
    assert not lost(decide, 0.0, correlation).any()
    assert lost(decide, 1.0, correlation).all()

"""Compare with closed forms of the chain's stationary behaviour."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from noack.impairments.kinds.loss import LossOf
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss

ERRORS = 5


def lost(decide: Any, chain: GilbertElliottLoss, count: int = 400_000, **more: Any) -> Any:
    return decide([LossOf(loss=chain)], count, **more).fates == 1


def burst_lengths(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the lengths of the complete loss bursts."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags]).astype(np.int8)))
    pairs = edges[: len(edges) // 2 * 2].reshape(-1, 2)
    return np.asarray(pairs[:, 1] - pairs[:, 0])


@pytest.mark.parametrize(("p", "r"), [(0.05, 0.25), (0.3, 0.6), (0.01, 0.5), (0.5, 0.1)])
def test_bursts_last_as_long_as_the_bad_state(
    decide: Any, share_is: Callable[..., None], p: float, r: float
) -> None:
    """No loss in the good state, all lost in the bad state: bursts are geometric, mean 1/r."""
    flags = lost(decide, GilbertElliottLoss(good_to_bad=p, bad_to_good=r))
    share_is(flags, p / (p + r))
    bursts = burst_lengths(flags)
    error = np.sqrt(1 - r) / r / np.sqrt(len(bursts))  # bursts are independent
    assert abs(bursts.mean() - 1 / r) <= ERRORS * error
    # Check the geometric distribution beyond its mean: P(length = 1) = r.
    assert abs(np.mean(bursts == 1) - r) <= ERRORS * np.sqrt(r * (1 - r) / len(bursts))


def test_both_states_may_lose_some(decide: Any, share_is: Callable[..., None]) -> None:
    """Rate π₁λ₁ + π₂λ₂; P(lost, then not) = π Λ P (1 − Λ) 1 determines the mean burst."""
    p, r = 0.1, 0.3
    rates = np.array([0.05, 0.6])
    chain = GilbertElliottLoss(good_to_bad=p, bad_to_good=r, loss_in_good=0.05, loss_in_bad=0.6)
    flags = lost(decide, chain)
    stationary = np.array([r, p]) / (p + r)
    P = np.array([[1 - p, p], [r, 1 - r]])
    share_is(flags, float(stationary @ rates))
    share_is(flags[:-1] & ~flags[1:], float(stationary * rates @ P @ (1 - rates)))


@pytest.mark.parametrize(("loss", "burst"), [(0.01, 3.0), (0.1, 1.5), (0.6, 8.0)])
def test_mean_loss_and_mean_burst(
    decide: Any, share_is: Callable[..., None], loss: float, burst: float
) -> None:
    flags = lost(decide, GilbertElliottLoss(mean_loss=loss, mean_burst=burst))
    share_is(flags, loss)
    lengths = burst_lengths(flags)
    assert abs(lengths.mean() - burst) <= ERRORS * lengths.std() / np.sqrt(len(lengths))


def test_the_chain_starts_in_the_good_state(decide: Any) -> None:
    """The chain moves before each datagram, so the first datagram is lost with probability p."""
    chain = GilbertElliottLoss(good_to_bad=0.2, bad_to_good=0.01)
    first = lost(decide, chain, 20_000, flows=np.arange(20_000))
    assert abs(first.mean() - 0.2) <= ERRORS * np.sqrt(0.2 * 0.8 / len(first))


def test_a_chain_that_never_moves_never_loses(decide: Any) -> None:
    assert not lost(decide, GilbertElliottLoss(good_to_bad=0.0, bad_to_good=0.0), 10_000).any()
    assert not lost(decide, GilbertElliottLoss(mean_loss=0.0, mean_burst=1.0), 10_000).any()
    assert lost(decide, GilbertElliottLoss(good_to_bad=1.0, bad_to_good=0.0), 10_000).all()

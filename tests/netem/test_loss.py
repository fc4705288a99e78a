"""Loss models without a cap, against the closed forms of their stationary behaviour."""

import numpy as np
import pytest
from numpy.typing import NDArray

from netem.loss import loss_model
from netem.loss.gilbert_elliott import GilbertElliottLoss
from noack.rng import stream
from noack.scenario import Bernoulli, GilbertElliott, Lossless, WorstCase

DRAWS = 400_000
BATCHES = 200
ERRORS = 5
"""Standard errors allowed; by chance one test in a million would fail, and the seeds are fixed."""

Flags = NDArray[np.bool_]


def draw(loss: object, seed: int = 0, draws: int = DRAWS) -> Flags:
    lost = loss_model(loss, stream(seed, "test")).lost  # type: ignore[arg-type]
    return np.fromiter((lost() for _ in range(draws)), bool, draws)


def assert_rate(flags: NDArray[np.generic], expected: float) -> None:
    """The mean is as expected, to its standard error as the spread of batch means tells it.

    Successive losses are correlated, but hardly over the length of a batch.
    """
    means = flags[: len(flags) // BATCHES * BATCHES].reshape(BATCHES, -1).mean(axis=1)
    error = means.std(ddof=1) / np.sqrt(BATCHES)
    assert abs(means.mean() - expected) <= ERRORS * error
    assert error < 0.1 * expected  # so that the line above says something


def burst_lengths(lost: Flags) -> NDArray[np.int64]:
    """Lengths of the runs of losses that have both begun and ended."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost]).astype(np.int8)))
    pairs = edges[: len(edges) // 2 * 2].reshape(-1, 2)
    return np.asarray(pairs[:, 1] - pairs[:, 0])


@pytest.mark.parametrize("p", [0.02, 0.3, 0.8])
def test_bernoulli_loses_at_its_rate_and_without_memory(p: float) -> None:
    lost = draw(Bernoulli(model="bernoulli", probability=p))
    assert_rate(lost, p)
    assert_rate(lost[1:] & lost[:-1], p * p)


def test_nothing_and_everything_are_exact() -> None:
    assert not draw(Lossless(model="lossless"), draws=10_000).any()
    assert draw(WorstCase(model="worst_case"), draws=10_000).all()
    assert not draw(Bernoulli(model="bernoulli", probability=0), draws=10_000).any()
    assert draw(Bernoulli(model="bernoulli", probability=1), draws=10_000).all()


@pytest.mark.parametrize(("p", "r"), [(0.05, 0.25), (0.3, 0.6), (0.01, 0.5), (0.5, 0.1)])
def test_bursts_last_as_long_as_the_bad_state(p: float, r: float) -> None:
    """Nothing lost in the good state, all in the bad: bursts are geometric with mean 1/r."""
    lost = draw(GilbertElliott(model="gilbert_elliott", good_to_bad=p, bad_to_good=r))
    assert_rate(lost, p / (p + r))
    bursts = burst_lengths(lost)
    error = np.sqrt(1 - r) / r / np.sqrt(len(bursts))  # bursts are independent of each other
    assert abs(bursts.mean() - 1 / r) <= ERRORS * error
    # Geometric, not merely of that mean: P(length = 1) = r.
    assert abs(np.mean(bursts == 1) - r) <= ERRORS * np.sqrt(r * (1 - r) / len(bursts))


def test_both_states_may_lose_some() -> None:
    """Rate π₁λ₁ + π₂λ₂; P(lost, then not) = π Λ P (1 − Λ) 1, which fixes the mean burst length."""
    p, r = 0.1, 0.3
    rates = np.array([0.05, 0.6])
    lost = draw(
        GilbertElliott(
            model="gilbert_elliott",
            good_to_bad=p,
            bad_to_good=r,
            loss_in_good=rates[0],
            loss_in_bad=rates[1],
        )
    )
    stationary = np.array([r, p]) / (p + r)
    P = np.array([[1 - p, p], [r, 1 - r]])
    assert_rate(lost, float(stationary @ rates))
    ending = float(stationary * rates @ P @ (1 - rates))
    assert_rate(lost[:-1] & ~lost[1:], ending)
    expected = float(stationary @ rates) / ending
    bursts = burst_lengths(lost)
    error = bursts.std(ddof=1) / np.sqrt(len(bursts))
    assert abs(bursts.mean() - expected) <= ERRORS * error


def test_the_chain_starts_in_the_good_state() -> None:
    """It moves before each datagram, so the first is lost with probability p."""
    p = 0.2
    first = np.array(
        [GilbertElliottLoss(p, 0.01, 0.0, 1.0, stream(seed, "test")).lost() for seed in range(3000)]
    )
    assert abs(first.mean() - p) <= ERRORS * np.sqrt(p * (1 - p) / len(first))


@pytest.mark.parametrize(
    "loss",
    [
        Bernoulli(model="bernoulli", probability=0.5),
        GilbertElliott(model="gilbert_elliott", good_to_bad=0.3, bad_to_good=0.4),
    ],
    ids=lambda loss: loss.model,
)
def test_the_stream_alone_decides(loss: object) -> None:
    np.testing.assert_array_equal(draw(loss, seed=3, draws=1000), draw(loss, seed=3, draws=1000))
    assert (draw(loss, seed=3, draws=1000) != draw(loss, seed=4, draws=1000)).any()

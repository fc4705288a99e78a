"""Fits of loss models, against brute force, closed forms and simulated networks."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.measurement.chain_fits import ChainFits, ChainRates, LossLikelihood
from cosim.measurement.loss_bursts import (
    binomial_estimate,
    exponential_estimate,
    loss_bursts,
    poisson_estimate,
)
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from tests.cosim.measurement.chains import chain_losses

GILBERT = ChainRates(0.02, 0.2, 0.0, 1.0)
ELLIOTT = ChainRates(0.02, 0.1, 0.01, 0.6)
chances = st.floats(0.01, 0.99)
rates = st.builds(ChainRates, chances, chances, chances, chances)


def forward(lost: list[bool], one: ChainRates) -> float:
    """The likelihood by the forward algorithm, packet by packet."""
    start, delivers, loses = one.matrices()
    for flag in lost:
        start = start @ (loses if flag else delivers)
    return math.log(start.sum())


@settings(max_examples=60, deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=40), rates, st.data())
def test_the_likelihood_is_that_of_the_forward_algorithm(
    lost: list[bool], one: ChainRates, data: st.DataObject
) -> None:
    bursts = loss_bursts(~np.array(lost))
    assert LossLikelihood(bursts)(one) == pytest.approx(forward(lost, one), abs=1e-9)
    chosen = data.draw(
        st.lists(st.booleans(), min_size=len(bursts.length), max_size=len(bursts.length))
    )
    left_out, expected, begin = np.array(chosen, bool), 0.0, 0
    for first, end in zip(bursts.first[left_out], bursts.end[left_out], strict=True):
        expected += forward(lost[begin:first], one)
        begin = end
    expected += forward(lost[begin:], one)
    assert LossLikelihood(bursts, left_out)(one) == pytest.approx(expected, abs=1e-9)


def test_the_chain_is_the_emulators() -> None:
    chain = GilbertElliottLoss(**ELLIOTT._asdict()).chains()[0]
    _, delivers, loses = ELLIOTT.matrices()
    np.testing.assert_allclose(delivers + loses, chain.moves)
    np.testing.assert_allclose(loses, chain.moves * chain.acts)


def test_lengths_follow_the_survival_function() -> None:
    lost = chain_losses(100_000, ELLIOTT, seed=1)
    bursts = loss_bursts(~lost)
    for observed, which in ((bursts.length, True), (bursts.deliveries()[1:-1], False)):
        at = np.array([1, 2, 4, 8, 16])
        expected = ELLIOTT.survival(lost=which)(at.astype(float))
        found = (observed[:, None] >= at).mean(axis=0)
        np.testing.assert_allclose(found, expected, atol=4 * 0.5 / math.sqrt(len(observed)))


def test_gilberts_chain_in_closed_form() -> None:
    lost = np.array([0, 0, 1, 1, 0, 1, 0, 0, 0, 1], bool)  # by hand: 6 from good, 3 of them to bad
    fit = ChainFits(loss_bursts(~lost)).gilbert.estimates
    assert (fit["good_to_bad"].value, fit["bad_to_good"].value) == (3 / 6, 2 / 3)  # type: ignore[union-attr]


def test_intervals_of_gilberts_chain_cover_its_parameters() -> None:
    """200 networks: 95 % ± 4 standard deviations."""
    covered = np.zeros(2)
    for seed in range(200):
        fit = ChainFits(loss_bursts(~chain_losses(1500, GILBERT, seed))).gilbert
        covered += [
            one is not None and one.low <= truth <= one.high
            for one, truth in zip(fit.estimates.values(), GILBERT, strict=False)
        ]
    assert (abs(covered / 200 - 0.95) < 4 * math.sqrt(0.95 * 0.05 / 200)).all()


def test_intervals_of_the_hidden_chain_cover_its_parameters() -> None:
    """4 networks, 4 parameters each: at least 13 of 16 (fewer: probability 7e-3 at 95 %)."""
    covered, biases = 0, []
    for seed in range(4):
        fit = ChainFits(loss_bursts(~chain_losses(4000, ELLIOTT, seed))).gilbert_elliott
        for name, truth in ELLIOTT._asdict().items():
            one = fit.estimates[name]
            assert one is not None
            covered += one.low <= truth <= one.high
        biases.append(np.log(np.array(fit.rates) / np.array(ELLIOTT)))
    assert covered >= 13
    assert (abs(np.mean(biases, axis=0)) < 0.2).all()


@pytest.mark.parametrize("seed", [105, 112, 119])
def test_profiles_with_several_valleys_have_ends(seed: int) -> None:
    """Of 200 random chains, those with which the likelihood's valleys were taken for each other."""
    rng = np.random.default_rng(seed)
    p, r = 10 ** rng.uniform(-2.5, -0.3), 10 ** rng.uniform(-1.5, 0)
    one = ChainRates(p, r, rng.choice([0, rng.uniform(0, 0.2)]), rng.uniform(0.2, 1))
    fits = ChainFits(loss_bursts(~chain_losses(int(rng.choice([300, 700, 1500])), one, seed)))
    for estimate in fits.gilbert_elliott.estimates.values():
        assert estimate is not None
        assert 0 <= estimate.low <= estimate.value <= estimate.high <= 1


def test_the_preferred_model_is_the_true_one() -> None:
    independent = ChainRates(0.5, 0.5, 0.1, 0.1)
    for truth, name in ((independent, "bernoulli"), (GILBERT, "gilbert"),
                        (ELLIOTT, "gilbert_elliott")):  # fmt: skip
        bursts = loss_bursts(~chain_losses(8000, truth, seed=5))
        fits = ChainFits(bursts)
        assert fits.chosen.model == name
        assert fits.tested(fits.chosen).verdict == "not rejected"


def test_the_test_of_lengths_rejects_at_its_level_and_wrong_models() -> None:
    found = []
    for seed in range(100):
        fits = ChainFits(loss_bursts(~chain_losses(3000, GILBERT, seed)))
        found.append(fits.tested(fits.gilbert).p_value)
    p_values = np.array(found, float)
    assert 0.01 < (p_values < 0.05).mean() < 0.12
    fits = ChainFits(loss_bursts(~chain_losses(8000, ELLIOTT, seed=2)))
    assert fits.tested(fits.gilbert).verdict == "rejected"
    few = ChainFits(loss_bursts(~np.array([0, 1, 0, 0, 1, 1, 0], bool)))
    assert "too few" in few.tested(few.gilbert).verdict


@pytest.mark.parametrize(
    ("count", "low", "high"), [(0, 0.0, 3.689), (1, 0.0253, 5.572), (10, 4.795, 18.39)]
)
def test_poisson_intervals_are_garwoods(count: int, low: float, high: float) -> None:
    """Garwood, Biometrika 28, 1936, and every table since."""
    found = poisson_estimate(count, 2.0)
    np.testing.assert_allclose(found, [count / 2, low / 2, high / 2], rtol=2e-3)


def test_binomial_and_exponential_intervals_at_their_edges() -> None:
    assert binomial_estimate(0, 0) is None
    assert exponential_estimate(0, 3.0) is None
    none, every = binomial_estimate(0, 50), binomial_estimate(50, 50)
    assert none is not None
    assert every is not None
    limit = 1 - math.exp(-1.920729 / 50)  # (1 − p)^50 = e^(−χ²/2)
    assert (none.low, every.high) == (0.0, 1.0)
    assert (none.high, every.low) == pytest.approx((limit, 1 - limit))
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(1000):
        one = exponential_estimate(4, rng.exponential(2.0, 4).sum())
        inside.append(one is not None and one.low <= 2.0 <= one.high)
    assert abs(np.mean(inside) - 0.95) < 0.03

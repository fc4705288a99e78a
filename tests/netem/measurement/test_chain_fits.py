"""Fits of loss models: against definitions, closed forms and simulation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from netem.measurement.chain_fits import ChainFits, ChainRates, LossLikelihood
from netem.measurement.loss_bursts import loss_bursts
from tests.netem.measurement.chains import ELLIOTT, GILBERT, chain_losses

chances = st.floats(0.01, 0.99)
rates = st.builds(ChainRates, chances, chances, chances, chances)


def forward(lost: list[bool], rates: ChainRates) -> float:
    """The likelihood by the forward algorithm, packet by packet."""
    start, delivers, loses = rates.matrices()
    for flag in lost:
        start = start @ (loses if flag else delivers)
    return math.log(start.sum())


@settings(max_examples=60, deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=40), rates, st.data())
def test_the_likelihood_is_that_of_the_forward_algorithm(
    lost: list[bool], chain: ChainRates, data: st.DataObject
) -> None:
    bursts = loss_bursts(~np.array(lost))
    assert LossLikelihood(bursts)(chain) == pytest.approx(forward(lost, chain), abs=1e-9)
    chosen = data.draw(st.lists(st.booleans(), min_size=len(bursts.length), max_size=len(bursts.length)))
    left_out, expected, begin = np.array(chosen, bool), 0.0, 0
    for first, end in zip(bursts.first[left_out], bursts.end[left_out], strict=True):
        expected += forward(lost[begin:first], chain)
        begin = end
    expected += forward(lost[begin:], chain)
    assert LossLikelihood(bursts, left_out)(chain) == pytest.approx(expected, abs=1e-9)


def test_the_fitted_chain_has_the_matrices_of_the_emulators() -> None:
    chain = GilbertElliottLoss(**ELLIOTT._asdict()).chains()[0]
    _, delivers, loses = ELLIOTT.matrices()
    np.testing.assert_allclose(delivers + loses, chain.transitions)
    np.testing.assert_allclose(loses, chain.transitions * chain.acts)


def test_the_fit_of_gilberts_chain_is_the_share_of_its_moves() -> None:
    lost = np.array([0, 0, 1, 1, 0, 1, 0, 0, 0, 1], bool)  # by hand: 6 from good, 3 of them to bad
    fit = ChainFits(loss_bursts(~lost)).gilbert.estimates
    assert (fit["good_to_bad"].value, fit["bad_to_good"].value) == (3 / 6, 2 / 3)  # type: ignore[union-attr]


def test_intervals_of_gilberts_chain_cover_its_parameters() -> None:
    """200 networks: 95 % ± 4 standard deviations."""
    covered = np.zeros(2)
    for seed in range(200):
        fit = ChainFits(loss_bursts(~chain_losses(1500, GILBERT, seed))).gilbert
        covered += [
            estimate is not None and estimate.low <= truth <= estimate.high
            for estimate, truth in zip(fit.estimates.values(), GILBERT, strict=False)
        ]
    assert (abs(covered / 200 - 0.95) < 4 * math.sqrt(0.95 * 0.05 / 200)).all()


def test_intervals_of_the_hidden_chain_cover_its_parameters() -> None:
    """4 networks, 4 parameters each: at least 13 of 16 (fewer: probability 7e-3 at 95 %)."""
    covered, biases = 0, []
    for seed in range(4):
        fit = ChainFits(loss_bursts(~chain_losses(4000, ELLIOTT, seed))).gilbert_elliott
        for name, truth in ELLIOTT._asdict().items():
            estimate = fit.estimates[name]
            assert estimate is not None
            covered += estimate.low <= truth <= estimate.high
        biases.append(np.log(np.array(fit.rates) / np.array(ELLIOTT)))
    assert covered >= 13
    assert (abs(np.mean(biases, axis=0)) < 0.2).all()


def test_the_preferred_model_is_the_true_one() -> None:
    independent = ChainRates(0.5, 0.5, 0.1, 0.1)
    for truth, name in ((independent, "bernoulli"), (GILBERT, "gilbert"),
                        (ELLIOTT, "gilbert_elliott")):  # fmt: skip
        bursts = loss_bursts(~chain_losses(8000, truth, seed=5))
        fits = ChainFits(bursts)
        assert fits.chosen.model == name
        assert fits.test(fits.chosen).verdict == "not rejected"


def test_losses_in_bursts_are_not_called_independent() -> None:
    # 40 losses among 800 packets, mostly in pairs: by the lengths alone nothing is seen.
    chain = ChainRates(0.02, 0.6, 0.0, 1.0)
    verdicts = []
    for seed in range(30):
        fits = ChainFits(loss_bursts(~chain_losses(800, chain, seed)))
        verdicts.append(fits.test(fits.bernoulli).verdict)
    assert verdicts.count("rejected") >= 28
    # Independent losses are rejected at the level of the test.
    for packets, share in ((800, 0.05), (3000, 0.1), (200, 0.3)):
        independent = ChainRates(0.5, 0.5, share, share)
        rejected = 0
        for seed in range(100):
            fits = ChainFits(loss_bursts(~chain_losses(packets, independent, seed)))
            p_value = fits.test(fits.bernoulli).p_value
            rejected += p_value is not None and p_value < 0.01
        assert rejected <= 5  # 1 is expected; more than 5: probability 5e-4


def test_the_test_of_lengths_rejects_at_its_level_and_wrong_models() -> None:
    tests = []
    for seed in range(100):
        fits = ChainFits(loss_bursts(~chain_losses(3000, GILBERT, seed)))
        tests.append(fits.test(fits.gilbert).p_value)
    p_values = np.array(tests, float)
    assert 0.01 < (p_values < 0.05).mean() < 0.12
    fits = ChainFits(loss_bursts(~chain_losses(8000, ELLIOTT, seed=2)))
    assert fits.test(fits.gilbert).verdict == "rejected"
    few = ChainFits(loss_bursts(~np.array([0, 1, 0, 0, 1, 1, 0], bool)))
    assert "too few" in few.test(few.gilbert).verdict

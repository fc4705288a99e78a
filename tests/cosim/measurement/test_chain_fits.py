"""Outages and fits of loss models: against definitions, closed forms and simulation."""

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.measurement import chain_fits as rule
from cosim.measurement.chain_fits import ChainFits, ChainRates, LossLikelihood, find_outages, fit_outages
from cosim.measurement.loss_bursts import loss_bursts
from cosim.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.traces.packet_trace import read_trace
from tests.cosim.measurement.chains import chain_losses

GILBERT = ChainRates(0.02, 0.2, 0.0, 1.0)
ELLIOTT = ChainRates(0.02, 0.1, 0.01, 0.6)
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
    lost: list[bool], one: ChainRates, data: st.DataObject
) -> None:
    bursts = loss_bursts(~np.array(lost))
    assert LossLikelihood(bursts)(one) == pytest.approx(forward(lost, one), abs=1e-9)
    chosen = data.draw(st.lists(st.booleans(), min_size=len(bursts.length), max_size=len(bursts.length)))
    left_out, expected, begin = np.array(chosen, bool), 0.0, 0
    for first, end in zip(bursts.first[left_out], bursts.end[left_out], strict=True):
        expected += forward(lost[begin:first], one)
        begin = end
    expected += forward(lost[begin:], one)
    assert LossLikelihood(bursts, left_out)(one) == pytest.approx(expected, abs=1e-9)


def test_the_fitted_chain_has_the_matrices_of_the_emulators() -> None:
    chain = GilbertElliottLoss(**ELLIOTT._asdict()).chains()[0]
    _, delivers, loses = ELLIOTT.matrices()
    np.testing.assert_allclose(delivers + loses, chain.moves)
    np.testing.assert_allclose(loses, chain.moves * chain.acts)


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
        assert fits.tested(fits.chosen).verdict == "not rejected"


def test_the_test_of_lengths_rejects_at_its_level_and_wrong_models() -> None:
    tests = []
    for seed in range(100):
        fits = ChainFits(loss_bursts(~chain_losses(3000, GILBERT, seed)))
        tests.append(fits.tested(fits.gilbert).p_value)
    p_values = np.array(tests, float)
    assert 0.01 < (p_values < 0.05).mean() < 0.12
    fits = ChainFits(loss_bursts(~chain_losses(8000, ELLIOTT, seed=2)))
    assert fits.tested(fits.gilbert).verdict == "rejected"
    few = ChainFits(loss_bursts(~np.array([0, 1, 0, 0, 1, 1, 0], bool)))
    assert "too few" in few.tested(few.gilbert).verdict


TRACES = Path(__file__).parents[3] / "noack/traces/shipped/cicv5g"


def test_the_rural_run_has_one_outage_of_ten_seconds_and_an_m_without_it() -> None:
    trace = read_trace(TRACES / "rural_n8_10kmh.csv")
    measurement = NetworkMeasurement(trace, MeasurementOptions(deadline_s=0.1))
    (outage,) = measurement.to_json()["outages"]
    assert outage["losses"] == 175
    assert 10 < outage["duration_s"] < 11.5
    assert measurement.longest_loss_burst + 1 == measurement.quantiles[-1].bursts == 49
    by_hand = NetworkMeasurement(trace, MeasurementOptions(deadline_s=0.1, outage_s=2.0))
    durations_s = by_hand.bursts.times_s(trace)[1]
    assert by_hand.is_outage.tolist() == (durations_s >= 2.0).tolist()
    assert by_hand.is_outage.sum() == 2


@pytest.mark.parametrize("truth", [ChainRates(0.03, 0.25, 0.0, 1.0), ChainRates(0.01, 0.05, 0.02, 0.7)])
def test_networks_without_outages_have_none_and_added_ones_are_found(truth: ChainRates) -> None:
    rng = np.random.default_rng(1)
    for seed in range(40):
        lost = chain_losses(3000, truth, seed)
        assert not find_outages(loss_bursts(~lost)).flags.any()
    for outages in (1, 2, 4):
        lost = chain_losses(5000, truth, seed=outages)
        starts = np.sort(rng.choice(np.arange(2, 48), outages, replace=False)) * 100
        for start in starts[::-1]:
            lost = np.insert(lost, start, np.ones(rng.integers(220, 260), bool))
        bursts = loss_bursts(~lost)
        flags = find_outages(bursts).flags
        assert flags.sum() == outages
        assert bursts.length[flags].min() >= 220


def test_the_bound_for_geometric_bursts_counts_the_ways_to_divide_the_losses() -> None:
    lengths = np.array([7, 2, 1, 1])
    total, count = lengths.sum(), len(lengths)
    divisions = [np.diff([0, *cuts, total]) for cuts in combinations(range(1, total), count - 1)]
    exact = np.mean([np.max(division) >= lengths[0] for division in divisions])
    bound = rule._geometric(lengths)[0]
    assert exact == pytest.approx(bound)  # two parts of 7 or more do not fit into 11


def test_the_outage_fit_covers_rate_and_duration() -> None:
    rng, covered = np.random.default_rng(4), np.zeros(2)
    for _ in range(200):
        starts = np.cumsum(rng.exponential(20.0, 100))
        count = int((starts < 100).sum())
        durations_s = rng.exponential(3.0, count)
        every = np.ones(count, bool)
        fit = fit_outages(durations_s, every, 100 + durations_s.sum())
        for index, (estimate, truth) in enumerate(((fit.rate_per_s, 1 / 20), (fit.duration_s, 3.0))):
            covered[index] += estimate is not None and estimate.low <= truth <= estimate.high
    assert (covered / 200 > 0.92).all()  # exact intervals cover at least 95 %
    forty_s = np.full(40, 2.0) + 0.01 * np.arange(40)
    assert "rejected" in fit_outages(forty_s, np.ones(40, bool), 500.0).text
    assert "not rejected" in fit_outages(rng.exponential(2.0, 40), np.ones(40, bool), 500.0).text
    no_outages = fit_outages(np.zeros(0), np.zeros(0, bool), 100.0)
    assert no_outages.rate_per_s is not None
    assert no_outages.duration_s is None
    assert no_outages.rate_per_s.high == pytest.approx(0.0369, rel=1e-3)

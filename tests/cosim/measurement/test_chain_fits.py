"""Bursts, outages and fits of loss models: against definitions, closed forms and simulation."""

import math
from itertools import combinations, groupby
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.measurement import chain_fits as rule
from cosim.measurement.chain_fits import ChainFits, ChainRates, LossLikelihood, find_outages, fit_outages
from cosim.measurement.interval_estimates import binomial_estimate, exponential_estimate, poisson_estimate
from cosim.measurement.loss_bursts import histogram, loss_bursts, most_losses, outcomes, quantile_m
from cosim.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.traces.packet_trace import packet_trace, read_trace
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


flags = st.lists(st.booleans(), min_size=1, max_size=60)


@given(st.lists(st.one_of(st.none(), st.integers(0, 9)), min_size=1, max_size=12), st.integers(0, 9))
def test_a_packet_is_effective_if_it_arrives_in_time_before_every_later_one(
    delays: list[int | None], deadline: int
) -> None:
    """The definition of docs/mansd.md, by a receiver that keeps only what is newer."""
    sent = 2 * np.arange(len(delays))
    arrivals = [(2 * k + d, k) for k, d in enumerate(delays) if d is not None]
    effective, newest = set(), -1
    for arrival, k in sorted(arrivals):
        if arrival - 2 * k <= deadline and k > newest:
            effective.add(k)
            newest = k
    lost = np.array([d is None for d in delays])
    received = sent + np.array([d or 0 for d in delays])
    packets = outcomes(packet_trace(sent, received, lost), deadline)
    assert set(np.flatnonzero(packets.effective).tolist()) == effective
    groups = np.array([packets.lost, packets.out_of_order, packets.late, packets.effective])
    assert (groups.sum(axis=0) == 1).all()


@given(flags)
def test_bursts_are_the_groups_of_consecutive_losses(effective: list[bool]) -> None:
    bursts = loss_bursts(np.array(effective))
    lengths = [len(list(group)) for ok, group in groupby(effective) if not ok]
    assert bursts.length.tolist() == lengths
    assert histogram(bursts) == {n: lengths.count(n) for n in sorted(set(lengths))}
    assert bursts.deliveries().sum() == sum(effective)
    assert bursts.complete.tolist() == [
        first > 0 and end < len(effective) for first, end in zip(bursts.first, bursts.end, strict=True)
    ]


@given(flags, st.sampled_from([0.1, 0.5, 0.75, 0.9, 1.0]))
def test_m_of_a_share_is_the_smallest_that_covers_it(effective: list[bool], share: float) -> None:
    bursts = loss_bursts(np.array(effective))
    counts, count = [], 0
    for ok in effective:
        count = 0 if ok else count + 1
        counts.append(count)
    quantile = quantile_m(bursts, share)
    values_of = {quantile.packets: counts, quantile.bursts: bursts.length.tolist()}
    for m, values in values_of.items():
        for smaller, covered in ((m, True), (m - 1, False)):
            within = sum(value <= smaller - 1 for value in values)
            assert (smaller < 1) or (within >= share * len(values) - 1e-9) is (covered or not values)


@given(flags, st.data())
def test_most_losses_are_those_of_the_worst_window(effective: list[bool], data: st.DataObject) -> None:
    bursts = loss_bursts(np.array(effective))
    chosen = data.draw(st.lists(st.booleans(), min_size=len(bursts.length), max_size=len(bursts.length)))
    left_out = np.array(chosen, bool)
    skipped = np.zeros(len(effective), bool)
    for first, end in zip(bursts.first[left_out], bursts.end[left_out], strict=True):
        skipped[first:end] = True
    windows = range(1, len(effective) + 3)
    expected = {}
    for window in windows:
        starts = range(len(effective) - window + 1)
        worst = [window - sum(effective[i : i + window]) for i in starts if not skipped[i : i + window].any()]
        if worst:
            expected[window] = max(worst)
    assert most_losses(bursts, windows, left_out) == expected


@pytest.mark.parametrize(("share", "fewest"), [(0.9, 29), (0.99, 299)])
def test_confidence_needs_as_many_bursts_as_wilks_says(share: float, fewest: int) -> None:
    """ln 0.05 / ln share, rounded up: then the longest burst is the limit."""
    assert fewest == math.ceil(math.log(0.05) / math.log(share))
    for count in (fewest - 1, fewest):
        effective = np.tile([True, False], count)
        confident = quantile_m(loss_bursts(effective), share).bursts_confident
        assert (confident is None) == (count < fewest)
    rng = np.random.default_rng(1)
    covered = [
        quantile_m(loss_bursts(_bursts(rng.geometric(0.3, 400))), share).bursts_confident for _ in range(400)
    ]
    truth = 1 + math.ceil(math.log(1 - share) / math.log(0.7))
    assert np.mean([m is not None and m >= truth for m in covered]) >= 0.93


def _bursts(lengths: np.ndarray) -> np.ndarray:
    steps = np.zeros(int(lengths.sum()) + len(lengths), bool)
    steps[np.cumsum(lengths + 1) - 1] = True
    return steps

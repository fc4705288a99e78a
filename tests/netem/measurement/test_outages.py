"""Outages: of a real trace, of simulated ones, and the tests' closed forms."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from netem.measurement import outages
from netem.measurement.chain_fits import ChainRates
from netem.measurement.loss_bursts import loss_bursts
from netem.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from netem.measurement.outages import find_outages, fit_outages
from netem.traces.packet_trace import read_trace
from tests.netem.measurement.chains import chain_losses

TRACES = Path(__file__).parents[3] / "netem/traces/shipped/cicv5g"


def test_the_rural_run_has_one_outage_of_ten_seconds_and_a_longest_burst_without_it() -> None:
    trace = read_trace(TRACES / "rural_n8_10kmh.csv")
    measurement = NetworkMeasurement(trace, MeasurementOptions(deadline_s=0.1))
    (outage,) = measurement.to_json()["outages"]
    assert outage["losses"] == 175
    assert 10 < outage["duration_s"] < 11.5
    assert measurement.longest_loss_burst == measurement.quantiles[-1].bursts == 48
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
    for added in (1, 2, 4):
        lost = chain_losses(5000, truth, seed=added)
        starts = np.sort(rng.choice(np.arange(2, 48), added, replace=False)) * 100
        for start in starts[::-1]:
            lost = np.insert(lost, start, np.ones(rng.integers(220, 260), bool))
        bursts = loss_bursts(~lost)
        flags = find_outages(bursts).flags
        assert flags.sum() == added
        assert bursts.length[flags].min() >= 220


def test_the_bound_for_geometric_bursts_counts_the_ways_to_divide_the_losses() -> None:
    lengths = np.array([7, 2, 1, 1])
    total, count = lengths.sum(), len(lengths)
    divisions = [np.diff([0, *cuts, total]) for cuts in combinations(range(1, total), count - 1)]
    exact = np.mean([np.max(division) >= lengths[0] for division in divisions])
    bound = outages._longest_burst_bounds(lengths)[0]
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
    near_equal_s = np.full(40, 2.0) + 0.01 * np.arange(40)
    assert "rejected" in fit_outages(near_equal_s, np.ones(40, bool), 500.0).text
    assert "not rejected" in fit_outages(rng.exponential(2.0, 40), np.ones(40, bool), 500.0).text
    no_outages = fit_outages(np.zeros(0), np.zeros(0, bool), 100.0)
    assert no_outages.rate_per_s is not None
    assert no_outages.duration_s is None
    assert no_outages.rate_per_s.high == pytest.approx(0.0369, rel=1e-3)

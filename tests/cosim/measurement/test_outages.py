"""Outages: when a burst is one, and the fit of their rate and duration."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from cosim.measurement import chain_fits as rule
from cosim.measurement.chain_fits import ChainRates, find_outages, fit_outages
from cosim.measurement.loss_bursts import LossBursts, loss_bursts
from cosim.measurement.network_measurement import Measurement, MeasurementOptions
from noack.traces.trace_formats import read_trace
from tests.cosim.measurement.chains import chain_losses

TRACES = Path(__file__).parents[3] / "noack/traces/shipped/cicv5g"
GILBERT = ChainRates(0.03, 0.25, 0.0, 1.0)
ELLIOTT = ChainRates(0.01, 0.05, 0.02, 0.7)


def measured(name: str, deadline_s: float | None) -> Measurement:
    trace = read_trace(TRACES / f"{name}.csv")
    return Measurement(trace, MeasurementOptions(deadline_s=deadline_s))


def test_the_rural_run_has_one_outage_of_ten_seconds_and_an_m_without_it() -> None:
    found = measured("rural_n8_10kmh", 0.1)
    (outage,) = found.to_json()["outages"]
    assert outage["losses"] == 175
    assert 10 < outage["duration_s"] < 11.5
    assert found.longest_loss_burst + 1 == 49
    assert found.quantiles[-1].bursts == 49


@pytest.mark.parametrize("name", ["rural_n8_10kmh", "urban_n78_40kmh", "arterial_n78_80kmh"])
def test_without_a_deadline_below_the_longest_delay_nothing_is_lost(name: str) -> None:
    longest_s = measured(name, None).delays.quantiles_s[1.0]
    for deadline_s in (None, longest_s, 100.0):
        found = measured(name, deadline_s)
        assert (found.bursts.losses, found.longest_loss_burst, found.is_outage.any()) == (
            0,
            0,
            False,
        )
    assert measured(name, longest_s - 1e-3).bursts.losses > 0


@pytest.mark.parametrize("truth", [GILBERT, ELLIOTT])
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
        found = find_outages(bursts).flags
        assert found.sum() == outages
        assert bursts.length[found].min() >= 220


def test_few_bursts_are_no_ground_for_an_outage() -> None:
    """The largest of b values is never surprising beside b − 1 unknown ones, for small b."""
    for lengths in ([500], [1, 500], [2, 1, 90]):
        first = np.cumsum([0, *lengths[:-1]]) + 100 * np.arange(1, len(lengths) + 1)
        found = find_outages(LossBursts(5000, first, np.array(lengths)))
        assert not found.flags.any()
        assert "too few" in found.reason


def test_the_bound_for_geometric_bursts_counts_the_ways_to_divide_the_losses() -> None:
    lengths = np.array([7, 2, 1, 1])
    total, parts = lengths.sum(), len(lengths)
    divisions = [np.diff([0, *cuts, total]) for cuts in combinations(range(1, total), parts - 1)]
    exact = np.mean([np.max(one) >= lengths[0] for one in divisions])
    bound = rule._geometric(lengths)[0]
    assert exact == pytest.approx(bound)  # two parts of 7 or more do not fit into 11


def test_outages_by_hand() -> None:
    found = measured("rural_n8_10kmh", 0.1)
    by_hand = Measurement(found.trace, MeasurementOptions(deadline_s=0.1, outage_s=2.0))
    durations_s = by_hand.bursts.times_s(found.trace)[1]
    assert by_hand.is_outage.tolist() == (durations_s >= 2.0).tolist()
    assert by_hand.is_outage.sum() == 2
    assert "as given" in by_hand.outage_rule.reason


def test_the_outage_fit_covers_rate_and_duration() -> None:
    rng, covered = np.random.default_rng(4), np.zeros(2)
    for _ in range(200):
        starts = np.cumsum(rng.exponential(20.0, 100))
        count = int((starts < 100).sum())
        durations_s = rng.exponential(3.0, count)
        every = np.ones(count, bool)
        fit = fit_outages(durations_s, every, 100 + durations_s.sum())
        for place, (one, truth) in enumerate(((fit.rate_per_s, 1 / 20), (fit.duration_s, 3.0))):
            covered[place] += one is not None and one.low <= truth <= one.high
    assert (covered / 200 > 0.92).all()  # exact intervals cover at least 95 %
    many = np.full(40, 2.0) + 0.01 * np.arange(40)
    assert "rejected" in fit_outages(many, np.ones(40, bool), 500.0).text
    assert "not rejected" in fit_outages(rng.exponential(2.0, 40), np.ones(40, bool), 500.0).text
    none = fit_outages(np.zeros(0), np.zeros(0, bool), 100.0)
    assert none.rate_per_s is not None
    assert none.duration_s is None
    assert none.rate_per_s.high == pytest.approx(0.0369, rel=1e-3)

"""Metrics of runs, certified errors, and intervals: against closed forms and definitions."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import t as student

from cosim.analysis.scenario_certificates import quick_certificate
from cosim.shipped_files import find_shipped
from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.studies.campaign.metrics import (
    Metric,
    burst_frequency,
    certified_error,
    compute_metrics,
    difference,
    estimate,
    interval_ranks,
)
from noack.core.linear_systems import Vector
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load as load_scenario
from noack.scenario.scenario_file import validate

SCENARIOS = Path(__file__).parents[4] / "scenarios"


def scalar(content: dict[str, Any], **changed: Any) -> Scenario:
    """x' = x + u, Â = 1, B̂ = 1, K = −3: the model decays like e^(−2t)."""
    content["model"] = {"A": [[1.0]], "B": [[1.0]], "gain": [[-3.0]]}
    content["plant"]["initial_state"] = [1.0]
    return resolve(validate(content | changed, "here"))


def test_a_scalar_models_certified_error_is_m_thresholds(content: dict[str, Any]) -> None:
    # e^{(−2+α)τ} ≤ 1: each of the M − 1 = 2 missed errors counts once, and so does the current one.
    assert certified_error(scalar(content)) == pytest.approx(3 * 0.5, rel=1e-3)
    content["trigger"]["alpha_per_s"] = 2.5  # faster than the model
    assert certified_error(scalar(content)) is None


def test_the_certified_error_bounds_that_of_a_plants_own_certificate() -> None:
    for name in ("lane_following", "lane_weighted"):
        resolved = resolve(load_scenario(SCENARIOS / f"{name}.toml"))
        error = quick_certificate(resolved, ideal=True).first("e_c")
        assert error is not None
        bound = certified_error(resolved)
        assert bound is not None
        assert bound >= 0.7 * error
        assert name != "lane_weighted" or bound == pytest.approx(5 * 0.5, rel=0.02)  # Δ = M


@pytest.mark.parametrize("failure", [DIVERGED, TOO_MANY_EVENTS])
def test_metrics_without_a_value_and_of_failed_runs_are_infinite(failure: int) -> None:
    columns = {
        "transmissions": np.array([10, 1, 1]),
        "deliveries": np.array([4, 1, 0]),
        "settling_s": np.array([1.5, math.nan, 0.1]),
        "sup_e_c_scaled": np.array([0.5, 0.25, 0.1]),
        "status": np.array([OK, OK, failure]),
    }
    metrics = compute_metrics(columns, 2.0)
    assert metrics["transmissions"].tolist() == [10.0, 1.0, math.inf]
    assert metrics["lost_share"].tolist() == [0.6, 0.0, math.inf]
    assert metrics["settling_s"].tolist() == [1.5, math.inf, math.inf]
    assert metrics["certificate_used"].tolist() == [0.25, 0.125, math.inf]
    assert "certificate_used" not in compute_metrics(columns, None)


def test_the_interval_of_a_mean_is_the_textbooks() -> None:
    values = np.array([1.0, 2.0, 4.0, 9.0])
    estimated = estimate(values)
    assert estimated.mean == 4.0
    deviation = math.sqrt(((values - 4.0) ** 2).sum() / 3)
    assert estimated.halfwidth == pytest.approx(student.ppf(0.975, 3) * deviation / 2, rel=1e-12)
    assert (estimated.median, estimated.q05, estimated.q95, estimated.largest) == (2.0, 1.0, 9.0, 9.0)


def test_infinite_values_count_for_quantiles_and_not_for_the_mean() -> None:
    estimated = estimate(np.array([3.0, math.inf, 1.0, math.inf, math.inf]))
    assert (estimated.draws, estimated.finite, estimated.mean) == (5, 2, 2.0)
    assert estimated.median == estimated.largest == math.inf
    single = estimate(np.array([1.0]))
    assert single.halfwidth == single.median_high == math.inf
    assert estimate(np.arange(6.0)).median_high == 5.0  # 1 − 2 · 2⁻⁶ > 0.95
    none = estimate(np.full(3, math.inf))
    assert (none.finite, none.mean, none.halfwidth) == (0, math.inf, math.inf)


def test_differences_are_taken_draw_by_draw() -> None:
    reference = np.array([1.0, 5.0, math.inf, math.inf, 2.0])
    values = np.array([2.0, 4.0, math.inf, 3.0, 2.0])
    differences = difference(values, reference)
    assert differences.estimate.mean == 0.0
    assert differences.estimate.finite == 3
    assert (differences.larger, differences.smaller) == (0.2, 0.4)
    assert differences.estimate.q05 == -math.inf
    assert differences.estimate.median == 0.0


def at_most(j: int, count: int, share: float) -> float:
    """P(Bin(count, share) ≤ j), term by term."""
    return math.fsum(math.comb(count, i) * share**i * (1 - share) ** (count - i) for i in range(j + 1))


@pytest.mark.parametrize(("count", "quantile"), [(100, 0.5), (200, 0.9), (400, 0.95)])
def test_ranks_are_the_tightest_with_the_required_confidence(count: int, quantile: float) -> None:
    low, high = interval_ranks(count, quantile)
    # The value of rank r (from 0) is above the quantile if at most r values are below it.
    assert at_most(high, count, quantile) >= 0.975 > at_most(high - 1, count, quantile)
    assert at_most(low, count, quantile) <= 0.025 < at_most(low + 1, count, quantile)


def test_the_share_of_runs_with_long_bursts_is_compared_with_its_probability() -> None:
    """For the largest number of packets, by the closed form for one packet in sequence."""
    loss = 'network.loss={model="bernoulli", probability=0.3}'
    settings = ("network.mansd=0", loss, "network.enforce_mansd=false")
    bursts = np.array([0.0, 1.0, 0.0, 3.0, np.inf])
    sent = np.array([2.0, 3.0, 4.0, 5.0, np.inf])
    metrics: dict[Metric, Vector] = {"longest_loss_burst": bursts, "transmissions": sent}
    path = find_shipped("lane_following", "scenarios")
    frequency = burst_frequency(load_scenario(path, settings), metrics)
    assert frequency is not None
    assert (frequency.longer, frequency.runs, frequency.packets) == (2, 4, 5)
    assert frequency.predicted == pytest.approx(1 - 0.7**4)  # the first packet is delivered
    assert frequency.low < 0.5 < frequency.high
    # The losses from a change on are not those of the scenario's start.
    changes = 'changes=[{at_s=1.0, set={"network.loss.probability"=0.9}}]'
    assert burst_frequency(load_scenario(path, (*settings, changes)), metrics) is None

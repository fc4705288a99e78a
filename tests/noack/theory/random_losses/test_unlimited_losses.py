"""Moments at events and of a run's largest values: closed forms, and sums by hand."""

import numpy as np
import pytest

import noack
from noack.theory.random_losses import unlimited_losses
from noack.theory.random_losses.unlimited_losses import BurstCertificate, moment_at_events, moments_of_runs
from tests.noack.theory.random_losses.example_losses import BURSTY, independent, scalar_loop


@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
def test_in_a_contracting_norm_the_moments_at_events_are_those_of_the_geometric_law(p: float) -> None:
    error = scalar_loop(2.0, 3.0, 0.0).error
    for order, expected in (1, 1 / (1 - p)), (2, (1 + p) ** 0.5 / (1 - p)):
        moment = moment_at_events(error, independent(p), 0.0, order)
        assert moment == pytest.approx(expected, rel=1e-6)
        assert moment_at_events(error, independent(p), 0.5, order) < moment


@pytest.mark.parametrize("order", [1, 2])
def test_moments_at_events_include_longer_bursts_than_are_counted(
    order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With three terms, the rest is bounded from above, and not far."""
    error, process = scalar_loop(2.0, 3.0, 0.0).error, BURSTY
    exact = moment_at_events(error, process, 0.0, order)
    monkeypatch.setattr(unlimited_losses, "_TERMS", 3)
    assert exact <= moment_at_events(error, process, 0.0, order) < 1.5 * exact


def test_the_mean_of_the_largest_values_of_runs_by_hand() -> None:
    """Runs whose longest burst is 0, 1 or 2 with probabilities 0.5, 0.3 and 0.2 keep 1, 3 and 4."""
    bursts = [
        BurstCertificate(most, probability, 9, 0.0, 0.5, bound, 10 * bound)
        for most, probability, bound in [(0, 0.5, 1.0), (1, 0.8, 3.0), (2, 1.0, 4.0)]
    ]
    mean, root_mean_square = moments_of_runs(bursts)
    assert mean.controller_error == pytest.approx(0.5 * 1 + 0.3 * 3 + 0.2 * 4)
    assert root_mean_square.controller_error == pytest.approx((0.5 * 1 + 0.3 * 9 + 0.2 * 16) ** 0.5)
    assert root_mean_square.state == pytest.approx(10 * root_mean_square.controller_error)
    assert (mean.most, mean.probability, mean.rate_per_s) == (2, 1.0, 0.5)
    assert moments_of_runs([]) == []


def test_the_largest_value_of_a_run_decays_as_slowly_as_the_bound_that_it_is_taken_from() -> None:
    """A deadline has bounds with a rate and smaller ones without: they must not be mixed.

    Hardly any update is lost, so a lossless run shows the mean of all runs.
    """
    rule = {"policy": "absolute", "delta": 0.05}
    settings = {
        "trigger": {"policy": "deadline", "interval_s": 0.2, "rule": rule},
        "network.enforce_mansd": False,
        "network.loss": {"model": "bernoulli", "probability": 1e-6},
    }
    scenario = noack.load("double_integrator", settings)
    unlimited = noack.certify(scenario).unlimited
    assert unlimited is not None
    samples = noack.simulate(scenario).samples()
    norms = np.hypot(samples["x_1"].to_numpy(), samples["x_2"].to_numpy())
    rates_and_states = [(bounds.rate_per_s, bounds.state) for bounds in unlimited.runs]
    rates_and_states += [(bounds.rate_per_s, bounds.state) for bounds in unlimited.bursts]
    for rate_per_s, state in rates_and_states:
        assert (norms * np.exp(rate_per_s * samples["t_s"].to_numpy())).max() <= state


def test_delta_of_a_constant_threshold_bounds_the_whole_error() -> None:
    """Of the error that decays and the one that does not, Δ was the first alone: 0.03 thresholds."""
    settings = {
        "trigger": {"policy": "absolute", "delta": 0.2},
        "plant.initial_state": [5.0, 0.0],
        "network.enforce_mansd": False,
        "network.loss": {"model": "bernoulli", "probability": 1e-6},
    }
    scenario = noack.load("double_integrator", settings)
    unlimited = noack.certify(scenario).unlimited
    assert unlimited is not None
    errors = noack.simulate(scenario).samples()["e_c_norm"].to_numpy()
    assert 0.9 * 0.2 < np.nanmax(errors) <= unlimited.bursts[0].delta * 0.2


def test_no_mean_of_largest_values_is_stated_for_normal_disturbances() -> None:
    """A certificate excludes runs with a certain probability; what they add to a mean is not bounded."""
    settings = {
        "network.enforce_mansd": False,
        "network.loss": {"model": "bernoulli", "probability": 1e-6},
        "plant.disturbances": [{"kind": "gaussian", "std": [0.01]}],
    }
    settings["certificate.exceedance_probability"] = 0.01
    unlimited = noack.certify(noack.load("double_integrator", settings)).unlimited
    assert unlimited is not None
    assert unlimited.bursts
    assert not unlimited.runs
    assert 0.98 < unlimited.bursts[-1].probability <= 0.99  # its inter-event time leaves out runs, too

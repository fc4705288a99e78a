"""The disturbances of a scenario in the form that the gains need, by hand."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

import noack
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.bounds.disturbances import EstimationError, bound_forcing, normal_bounds
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import stationary_covariance

GAUSSIAN = {"kind": "gaussian", "std": [0.5]}
UNIFORM = {"kind": "uniform", "bound": [0.2, 0.4], "at": "state"}


def scenario(*disturbances: object, noise_std: tuple[float, ...] | None = None) -> Scenario:
    """A double integrator with 100 steps of the plant in a second."""
    settings = {
        "plant.rate_hz": 100.0, "controller.rate_hz": 100.0, "horizon_s": 1.0,
        "plant.disturbances": disturbances, "certificate.exceedance_probability": 1e-3,
    }  # fmt: skip
    if noise_std is not None:
        settings["plant.measurement.noise_std"] = noise_std
    return resolve(noack.load("double_integrator", settings))


def test_normal_values_of_a_run_share_the_probability_of_exceedance() -> None:
    """At each of 101 steps: the value, their sum in the state, and the estimation error."""
    bounds = normal_bounds(scenario(GAUSSIAN, UNIFORM))
    assert bounds is not None
    assert bounds.probability == pytest.approx(1e-3 / (101 * 3))
    assert bounds.radius(2) == pytest.approx(math.sqrt(chi2.isf(bounds.probability, 2)))
    assert normal_bounds(scenario(UNIFORM)) is None


def test_disturbances_become_columns_of_the_states_derivative() -> None:
    resolved = scenario(GAUSSIAN, UNIFORM)
    B, bounds = loop_of(resolved).B, normal_bounds(resolved)
    forcing = bound_forcing(resolved, B)
    assert forcing is not None
    assert bounds is not None
    assert forcing.normal is not None
    assert forcing.columns == pytest.approx(np.diag([0.2, 0.4]))
    assert forcing.normal.columns == pytest.approx(0.5 * B)
    assert forcing.at_input == pytest.approx([0.5 * bounds.limit])
    assert bound_forcing(scenario(), B) is None


def test_without_an_observer_the_estimation_error_is_the_noise_in_the_triggers_norm() -> None:
    resolved = scenario(noise_std=(0.05, 0.05))
    loop, bounds = loop_of(resolved), normal_bounds(resolved)
    assert bounds is not None
    W = np.eye(2) if loop.weight is None else loop.weight
    expected = bounds.radius(2) * 0.05 * np.linalg.norm(W, 2)
    assert EstimationError(resolved, loop.A, loop.B, None).persistent().fixed == pytest.approx(expected)


def test_a_covariance_that_rounding_hides_is_not_returned() -> None:
    np.testing.assert_allclose(stationary_covariance(np.diag([0.5, 0.0]), np.eye(2)), np.diag([4 / 3, 1.0]))
    slow = np.array([[np.nextafter(1.0, 0.0), 100.0], [0.0, 0.5]])
    with pytest.raises(NotDecayingError, match="within rounding"):
        stationary_covariance(slow, np.eye(2))

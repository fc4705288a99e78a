"""Gains of observers and steady states of filters, against eigenvalues and solutions by hand."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from noack.observers.observer_settings import observer_gain, unobservable_mode
from noack.scenario.resolution import assumed_model, resolve, steady_state, true_model
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate


@pytest.fixture
def observed(content: dict[str, Any]) -> dict[str, Any]:
    """The double integrator with a noisy position measurement."""
    content["plant"] |= {"rate_hz": 100.0, "measurement": {"C": [[1.0, 0.0]], "noise_std": [0.01]}}
    content["controller"] = {"rate_hz": 100.0}
    content["observer"] = {
        "kind": "kalman", "input_std": [0.2], "initial_std": [1.0, 1.0],
    }  # fmt: skip
    return content


def resolved(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, "test"))


def test_complex_poles_and_several_outputs_are_placed() -> None:
    Ad = expm(np.array([[0.0, 1, 0], [0, 0, 1], [1, -2, 0.5]]) * 0.01)
    wanted = (np.exp((-3 + 4j) * 0.01), np.exp((-3 - 4j) * 0.01), np.exp(-9 * 0.01 + 0j))
    for outputs in (np.eye(3)[:1], np.eye(3)[[0, 2]], np.eye(3)):
        L = observer_gain(Ad, outputs, wanted)
        found = np.linalg.eigvals((np.eye(3) - L @ outputs) @ Ad)
        np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(wanted), atol=1e-7)


def test_an_unobservable_mode_is_reported_by_its_eigenvalue() -> None:
    Ad = np.diag([1.5, 0.5, 0.9])
    assert unobservable_mode(Ad, np.array([[1.0, 0.0, 0.0]])) is None
    assert unobservable_mode(Ad, np.array([[0.0, 1.0, 1.0]])) == 1.5
    assert unobservable_mode(Ad, np.array([[1.0, 1.0, 0.0]]), stable_too=True) == 0.9


def test_filter_settings_default_to_the_scenarios_noise_and_disturbances(
    observed: dict[str, Any],
) -> None:
    observed["plant"]["disturbances"] = [
        {"kind": "gaussian", "at": "input", "std": [0.3]},
        {"kind": "uniform", "at": "state", "bound": [0.0, 0.6]},
        {"kind": "sine", "amplitude": [5.0], "hz": 1.0},
    ]
    del observed["observer"]["input_std"]
    scenario = resolved(observed)
    believed, h = assumed_model(scenario), 0.01
    into = np.array([h**2 / 2, h])  # of the double integrator with a held input
    expected = (0.3**2 + 0.6**2 / 3) * np.outer(into, into)
    np.testing.assert_allclose(believed.Q, expected, rtol=1e-9)
    assert believed.R.tolist() == [[0.01**2]]
    observed["observer"] |= {"process_std": [0.0, 0.0], "input_std": [1.0], "noise_std": [0.5]}
    told = assumed_model(resolved(observed))
    np.testing.assert_allclose(told.Q, np.outer(into, into), rtol=1e-9)
    assert told.R.tolist() == [[0.25]]
    np.testing.assert_allclose(true_model(resolved(observed)).Q, expected, rtol=1e-9)


def test_the_scalar_steady_state_solves_the_quadratic_equation(content: dict[str, Any]) -> None:
    """P⁻ = a²P⁻R/(P⁻ + R) + q, solved by hand."""
    a, h, r, q = 2.0, 0.01, 0.04, 9e-4
    content["model"] = {"A": [[a]], "B": [[1.0]], "gain": [[-3.0]]}
    content["plant"] = {
        "initial_state": [0.0], "rate_hz": 100.0,
        "measurement": {"noise_std": [0.2]},
    }  # fmt: skip
    content["observer"] = {"kind": "kalman", "Q": [[q]], "initial_std": [1.0]}
    content["plant"]["disturbances"] = [
        {"kind": "gaussian", "at": "state", "std": [np.sqrt(q) * a / np.expm1(a * h)]}
    ]
    f = np.exp(2 * a * h)
    b = r * (1 - f) - q
    before = (-b + np.sqrt(b**2 + 4 * q * r)) / 2
    found = steady_state(resolved(content))
    assert found.covariance[0, 0] == pytest.approx(before * r / (before + r), rel=1e-9)
    assert found.gain[0, 0] == pytest.approx(before / (before + r), rel=1e-9)
    assert found.radius == pytest.approx(np.exp(a * h) * r / (before + r), rel=1e-9)

"""Kinds of loops: regulators, a hold, the schedule, a single state with the worst-case losses."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.simulation.continuous import run_continuous
from cosim.studies.design.design_search import DesignLimits, certificate_of, design
from cosim.studies.design.design_space import families_of, lqr_gain
from noack.core.errors import CallerError
from noack.core.linear_systems import spectral_abscissa
from noack.scenario.named_models import lane_following
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from tests.cosim.studies.design.conftest import designed
from tests.cosim.studies.design.test_command import ONE


def test_a_bound_under_the_schedule_is_that_of_the_scheduled_certificate(
    scenario: Scenario,
) -> None:
    """A real loop samples, holds and delays, so its certified bound is never smaller."""
    limits = DesignLimits(9.0, 0.8, 0.02, {"error": 0.2}, schedule=True)
    found = designed(scenario, limits, draws=60)
    assert found.feasible
    scheduled, ideal = (
        certificate_of(found.scenario, replace(limits, schedule=schedule)).constants
        for schedule in (True, False)
    )
    assert scheduled is not None
    assert ideal is not None
    assert scheduled.state > ideal.state
    assert found.bounds is not None
    assert found.bounds["state"] == pytest.approx(scheduled.state)
    assert found.document()["limits"]["under"] == "schedule"


def test_without_randomness_every_draw_is_the_exact_run(tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    path.write_text(ONE)
    families = families_of(load(path), ("identity",), None)
    found = design(families, DesignLimits(4.0, 0.5, 0.02, {}), draws=20, seed=0)
    assert found.confirmed
    assert found.fresh.halfwidth == 0
    assert found.fresh.settling_high_s == found.fresh.settling_s
    exact = run_continuous(resolve(found.scenario))
    assert found.fresh.transmissions == len(exact.event_s)
    x = exact.at([found.fresh.settling_s]).x
    assert abs(float(x[0, 0])) == pytest.approx(0.02, rel=1e-6)


def test_a_small_quantile_has_the_lower_limit_zero(mass: Path) -> None:
    found = designed(load(mass), DesignLimits(9.0, 0.02, 0.02, {}), draws=20)
    assert found.fresh.settling_low_s == 0
    assert 0 < found.fresh.settling_s <= found.fresh.settling_high_s < math.inf


def test_the_gain_comes_from_a_solution_of_the_riccati_equation() -> None:
    A, B, *_ = lane_following()
    Q, R = np.diag([1.0, 2.0, 3.0, 4.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    K = lqr_gain(A, B, Q, R)
    closed = A + B @ K
    assert spectral_abscissa(closed) < 0
    # P is the cost of the closed loop by another equation; K must follow from it.
    cost = Q + K.T @ R @ K
    n = len(A)
    lyapunov = np.kron(np.eye(n), closed.T) + np.kron(closed.T, np.eye(n))
    P = np.linalg.solve(lyapunov, -cost.ravel()).reshape(n, n)
    np.testing.assert_allclose(R @ K, -B.T @ P, rtol=1e-8, atol=1e-8)
    residual = A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q
    np.testing.assert_allclose(residual, 0.0, atol=1e-7)


def test_the_double_integrator_has_its_textbook_gain() -> None:
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    np.testing.assert_allclose(
        lqr_gain(A, B, np.eye(2), np.eye(1)), [[-1.0, -np.sqrt(3.0)]], rtol=1e-9
    )


@pytest.mark.parametrize(
    ("A", "Q", "R", "word"),
    [
        ([[1, 0], [0, -1]], [[1, 0], [0, 1]], 1, "stabilising"),  # B does not affect state 1
        ([[0, 1], [0, 0]], [[-1, 0], [0, -1]], 1, "semidefinite"),
        ([[0, 1], [0, 0]], [[1, 1], [0, 1]], 1, "symmetric"),
        ([[0, 1], [0, 0]], [[1, 0], [0, 1]], 0, "definite"),
    ],
)
def test_a_system_without_a_regulator_is_refused(
    A: list[list[float]], Q: list[list[float]], R: float, word: str
) -> None:
    with pytest.raises(CallerError, match=word):
        lqr_gain(np.array(A), np.array([[0.0], [1.0]]), np.array(Q), np.array([[R]]))

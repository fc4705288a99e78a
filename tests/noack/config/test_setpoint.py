"""Set-points: the equilibria of a model, by hand and against a solver."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.config.resolution import loop_of, resolve
from noack.config.scenario_checks import input_at
from noack.config.scenario_file import dumps, validate

A_DOUBLE, B_DOUBLE = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])


@pytest.mark.parametrize(("stiffness", "force"), [(0.0, 0.0), (2.0, 6.0)])
def test_the_equilibrium_input_balances_the_spring(stiffness: float, force: float) -> None:
    A = np.array([[0.0, 1.0], [-stiffness, -0.1]])
    assert input_at(A, B_DOUBLE, np.array([3.0, 0.0])) == pytest.approx([force])


def test_a_set_point_that_moves_is_refused_with_the_nearest_equilibrium() -> None:
    with pytest.raises(ValueError, match=r"dimension 1, and the nearest one is \[2, 0\]"):
        input_at(A_DOUBLE, B_DOUBLE, np.array([2.0, 1.0]))


def test_the_equilibrium_that_a_refusal_names_is_taken() -> None:
    A, B = np.array([[0.0, 1.0, 0.0], [0.0, -3.0, 0.7], [0.0, 0.0, 0.0]]), np.eye(3)[:, 2:]
    with pytest.raises(ValueError, match="nearest one is") as refused:
        input_at(A, B, np.array([0.1, 0.2, 0.3]))
    named = str(refused.value).partition("nearest one is ")[2]
    input_at(A, B, np.array(json.loads(named)))


def test_a_model_may_have_the_origin_as_its_only_equilibrium() -> None:
    with pytest.raises(ValueError, match="none but 0"):
        input_at(np.array([[1.0]]), np.zeros((1, 1)), np.array([1.0]))


@given(st.integers(0, 2**32 - 1))
def test_states_that_are_equilibria_by_construction_are_taken(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 6)), int(rng.integers(1, 4))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    x_r, u_r = rng.normal(size=n), rng.normal(size=m)
    A -= np.outer(A @ x_r + B @ u_r, x_r) / (x_r @ x_r)
    found = input_at(A, B, x_r)
    assert A @ x_r + B @ found == pytest.approx(np.zeros(n), abs=1e-9 * np.abs(A).max() * 10)


def test_the_set_point_of_a_scenario_is_used_in_its_loop(content: dict[str, Any]) -> None:
    content["controller"] = {"setpoint": [2.0, 0.0]}
    scenario = validate(content, "here")
    loop = loop_of(resolve(scenario))
    assert loop.setpoint is not None
    assert loop.setpoint_input is not None
    assert loop.setpoint.tolist() == [2.0, 0.0]
    assert loop.setpoint_input.tolist() == [0.0]
    assert "setpoint" in dumps(scenario)
    content["controller"] = {"setpoint": [0.0, 0.0]}
    assert loop_of(resolve(validate(content, "here"))).setpoint is None

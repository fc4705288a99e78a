"""From a scenario to a run: draws, matrices, and set points with their equilibria."""

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.errors import CallerError
from noack.scenario.named_models import lane_following
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_checks import input_at
from noack.scenario.scenario_file import dumps, load, validate

SCENARIOS = Path(__file__).parents[3] / "scenarios"
SEEDS = range(60)
WIDTH_A = np.array([[0.1, 0.2], [0.0, 1e-9]])
WIDTH_B = np.array([[0.05], [0.0]])


@pytest.fixture
def box(content: dict[str, Any]) -> dict[str, Any]:
    """A scenario that draws its plant from a box around the double integrator."""
    content["plant"] |= {
        "draw": "uniform",
        "uncertainty_A": WIDTH_A.tolist(),
        "uncertainty_B": WIDTH_B.tolist(),
        "initial_state": [1.0, -2.0],
        "initial_state_halfwidth": [0.5, 0.0],
    }
    return content


def resolved(content: dict[str, Any], **seeds: int) -> Scenario:
    return resolve(validate(content | {"seeds": seeds}, "here"))


def test_uniform_draws_fill_their_box_and_stay_inside(box: dict[str, Any]) -> None:
    loops = [loop_of(resolved(box, plant=seed, initial_state=seed)) for seed in SEEDS]
    for deviation, width in (
        (np.array([loop.A - loop.A_model for loop in loops]), WIDTH_A),
        (np.array([loop.B - loop.B_model for loop in loops]), WIDTH_B),
        (np.array([loop.x0 - [1.0, -2.0] for loop in loops]), np.array([0.5, 0.0])),
    ):
        # |Â| is at most 1 here: Â + d and the difference from Â are each rounded to 2⁻⁵³.
        assert (np.abs(deviation) <= width + 2.3e-16).all()
        spread = width > 1e-6
        # The extreme of 60 draws misses the outer 20 % at an end with probability 0.9^60 = 0.002.
        assert (deviation.max(axis=0)[spread] > 0.8 * width[spread]).all()
        assert (deviation.min(axis=0)[spread] < -0.8 * width[spread]).all()
        assert (deviation[:, width == 0] == 0).all()


def test_vertex_draws_are_corners_and_all_of_them_occur(box: dict[str, Any]) -> None:
    box["plant"]["draw"] = "vertex"
    corners = set()
    for seed in SEEDS:
        loop = loop_of(resolved(box, plant=seed))
        for true, model, width in (
            (loop.A, loop.A_model, WIDTH_A),
            (loop.B, loop.B_model, WIDTH_B),
        ):
            assert ((true == model + width) | (true == model - width)).all()
        corners.add((*(np.sign(loop.A - loop.A_model)[0]), np.sign(loop.B - loop.B_model)[0, 0]))
    # Eight corners in 60 draws: the probability of missing one is below 8 · (7/8)^60 = 0.003.
    assert len(corners) == 8


def test_seeds_are_independent_of_each_other(box: dict[str, Any]) -> None:
    base = resolved(box, plant=3, initial_state=4, loss=5)
    assert resolved(box, plant=3, initial_state=4, loss=5) == base
    for other, plant_stays, state_stays in (
        (resolved(box, plant=9, initial_state=4, loss=5), False, True),
        (resolved(box, plant=3, initial_state=9, loss=5), True, False),
        (resolved(box, plant=3, initial_state=4, loss=9), True, True),
    ):
        assert ((other.plant.A, other.plant.B) == (base.plant.A, base.plant.B)) is plant_stays
        assert (other.plant.initial_state == base.plant.initial_state) is state_stays


def test_widening_one_interval_does_not_change_the_other_draws(box: dict[str, Any]) -> None:
    before = loop_of(resolved(box, plant=3))
    box["plant"]["uncertainty_A"][0][0] = 5.0
    del box["plant"]["uncertainty_B"]
    after = loop_of(resolved(box, plant=3))
    assert (before.A != after.A).tolist() == [[True, False], [False, False]]
    assert after.A[0, 0] == pytest.approx(before.A[0, 0] * 50, rel=1e-14)  # Â is 0 there
    assert after.B.tolist() == after.B_model.tolist()


@pytest.mark.parametrize("draw", ["nominal", "given"])
def test_a_plant_that_is_not_drawn_is_what_the_file_says(
    content: dict[str, Any], draw: str
) -> None:
    given = {"A": [[1.0, 2.0], [3.0, 4.0]], "B": [[5.0], [6.0]]} if draw == "given" else {}
    content["plant"] |= {"draw": draw, **given}
    loop = loop_of(resolved(content))
    assert loop.A.tolist() == given.get("A", [[0.0, 1.0], [0.0, 0.0]])
    assert loop.B.tolist() == given.get("B", [[0.0], [1.0]])
    assert loop.A_model.tolist() == [[0.0, 1.0], [0.0, 0.0]]


def test_signal_names_are_the_models_or_generated(content: dict[str, Any]) -> None:
    def names() -> Sequence[Sequence[str]]:
        loop = loop_of(resolved(content))
        return loop.state_names, loop.input_names

    assert names() == (("position", "velocity"), ("force",))
    content["model"] |= {"state_names": ["s", "v"]}
    assert names() == (("s", "v"), ("force",))
    content["model"] = {"A": [[0.0]], "B": [[1.0, 2.0]], "gain": [[-1.0], [0.0]]}
    content["plant"]["initial_state"] = [1.0]
    assert names() == (("x_1",), ("u_1", "u_2"))


def test_the_gain_of_a_named_model_may_be_replaced(content: dict[str, Any]) -> None:
    content["model"] |= {"gain": [[-7.0, -8.0]], "parameters": {"stiffness": 3.0}}
    assert loop_of(resolved(content)).K.tolist() == [[-7.0, -8.0]]
    del content["model"]["gain"]
    assert loop_of(resolved(content)).K.tolist() == [[-3.0, -1.5]]


def test_the_shipped_lane_scenario_has_the_papers_numbers() -> None:
    """Â, B̂, K, β, α, M − 1 and the box of Section V."""
    scenario = load(SCENARIOS / "lane_following.toml")
    loop, paper = loop_of(resolve(scenario)), lane_following()
    for found, expected in ((loop.A_model, paper.A), (loop.B_model, paper.B), (loop.K, paper.K)):
        np.testing.assert_array_equal(found, expected)
    rule = scenario.trigger
    assert (rule.beta, rule.alpha_per_s, rule.floor, rule.weight) == (0.5, 0.25, 0, None)
    assert scenario.network.mansd == 4
    # Only the six physical parameters are uncertain: a ∈ ±0.1, b ∈ ±0.05.
    off_A, off_B = np.abs(loop.A - loop.A_model), np.abs(loop.B - loop.B_model)
    assert ((off_A > 0) == (np.indices((4, 4)).max(axis=0) < 2)).all()
    assert ((off_B > 0) == np.eye(4, 2, dtype=bool)).all()
    assert off_A.max() <= 0.1 + 1e-14  # rounding relative to 10.45
    assert off_B.max() <= 0.05 + 1e-14


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


POSITION: dict[str, Any] = {"C": [[1.0, 0.0]], "noise_std": [0.01]}


def test_a_state_disturbance_needs_a_linear_plant(content: dict[str, Any]) -> None:
    content["model"] = {
        "A": [[0.0] * 4] * 4, "B": [[0.0]] * 4, "gain": [[0.0] * 4], "allow_unstable": True,
    }  # fmt: skip
    content["plant"] = {
        "system": {"kind": "cart_pole"}, "initial_state": [0.0] * 4,
        "disturbances": [{"kind": "uniform", "at": "state", "bound": [1.0] * 4}],
    }  # fmt: skip
    with pytest.raises(CallerError, match=r"^file: plant.disturbances.0.at = .* a linear plant"):
        validate(content, "file")


def test_a_resolved_scenario_has_its_gain_and_resolves_to_itself(content: dict[str, Any]) -> None:
    content["plant"]["measurement"] = POSITION
    content["observer"] = {"kind": "luenberger", "poles_per_s": [[-5.0, 1.0]]}
    once = resolve(validate(content, "file"))
    assert once.observer is not None
    assert once.observer.kind == "luenberger"
    assert once.observer.gain is not None
    again = validate(tomllib.loads(dumps(once)), "again")
    assert again == once == resolve(again)

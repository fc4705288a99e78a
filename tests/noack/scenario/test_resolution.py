"""From a scenario to a run: draws, matrices, set points."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.plants.linear import lane_following
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load, validate

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


def test_the_shipped_lane_scenario_has_the_papers_numbers() -> None:
    """Â, B̂, K, β, α, M − 1 and the box of Section V."""
    scenario = load(SCENARIOS / "lane_following.toml")
    loop, paper = loop_of(resolve(scenario)), lane_following()
    for matrix, expected in ((loop.A_model, paper.A), (loop.B_model, paper.B), (loop.K, paper.K)):
        np.testing.assert_array_equal(matrix, expected)
    rule = scenario.trigger
    assert (rule.beta, rule.alpha_per_s, rule.floor, rule.weight) == (0.5, 0.25, 0, None)
    assert scenario.network.mansd == 4
    # Only the six physical parameters are uncertain: a ∈ ±0.1, b ∈ ±0.05.
    off_A, off_B = np.abs(loop.A - loop.A_model), np.abs(loop.B - loop.B_model)
    assert ((off_A > 0) == (np.indices((4, 4)).max(axis=0) < 2)).all()
    assert ((off_B > 0) == np.eye(4, 2, dtype=bool)).all()
    assert off_A.max() <= 0.1 + 1e-14  # rounding relative to 10.45
    assert off_B.max() <= 0.05 + 1e-14


def test_the_lane_model_is_the_papers() -> None:
    """The equations of Section V, written out, with its numbers: U = −12, d = 40, gain 1."""
    model = lane_following()
    rng = np.random.default_rng(0)
    (V, r, psi, Y_g), (u_1, u_2) = rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 2)
    expected = [
        -1.6579 * V + 10.45 * r - 12.1053 * u_1,
        0.4886 * V - 2.718 * r + 13.1429 * u_2,
        r,
        V - 12 * psi,
    ]
    state = np.array([V, r, psi, Y_g])
    np.testing.assert_allclose(model.A @ state + model.B @ [u_1, u_2], expected, rtol=1e-14)
    np.testing.assert_allclose(model.K @ state, [Y_g / 40 - psi] * 2, rtol=1e-14)
    assert model.state_names == ("V", "r", "psi", "Y_g")

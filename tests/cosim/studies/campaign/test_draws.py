"""Draws depend only on their number and have the distributions of the scenario."""

from pathlib import Path

import numpy as np
import pytest

from cosim.simulation.continuous import run_continuous
from cosim.studies.campaign.random_draws import box_of, drawn_scenario
from noack.impairments.kinds.replay import Replay
from noack.impairments.loss_models.lossless import NoLoss
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from tests.cosim.studies.campaign.conftest import Few
from tests.oracles.link import update_link_of


def with_plant(scenario: Scenario, **changed: object) -> Scenario:
    plant = scenario.plant.model_copy(update=changed)
    return scenario.model_copy(update={"plant": plant})


def test_draws_depend_neither_on_the_chunk_nor_on_the_grid_point(campaign: Few) -> None:
    first, *others = (point.work.box for point in campaign[1])
    whole = first.population(11, range(9))
    parts = [(slice(3, 5), first.population(11, range(3, 5)))]
    parts += [(slice(0, 9), box.population(11, range(9))) for box in others]
    for place, part in parts:
        for found, expected in zip(part, whole, strict=True):
            np.testing.assert_array_equal(found, expected[place])
    assert first.population(11, range(10**8, 10**8 + 1)).x0.shape == (1, 2)


def test_other_seeds_and_draws_give_other_numbers_throughout(campaign: Few) -> None:
    box = campaign[1][0].work.box
    first, second = box.population(11, range(2)), box.population(12, range(2))
    for one, another in zip(first, second, strict=True):
        if (one != one[0]).any():  # B has no uncertainty
            assert (one != another).any()
    assert (first.A[0] != first.A[1]).any()
    assert (first.x0[0] != first.x0[1]).all()
    assert first.loss_seeds[0] != first.loss_seeds[1]


def test_draws_are_uniform_in_the_box(campaign: Few) -> None:
    point = campaign[1][0]
    found = point.work.box.population(11, range(20_000))
    centre, half = loop_of(drawn_scenario(with_plant(point.scenario, draw="nominal"), 0, 0)), 0.2
    off = found.A[:, 1, 0] - centre.A[1, 0]
    assert np.abs(off).max() <= half
    # The standard deviation of a mean of 20,000 is below 0.001, that of a variance below 0.0001.
    assert abs(off.mean()) < 0.005
    assert off.var() == pytest.approx(half**2 / 3, abs=0.0005)
    np.testing.assert_array_equal(found.A[:, 0], np.broadcast_to(centre.A[0], (20_000, 2)))
    pairs = np.column_stack([off, found.A[:, 1, 1], found.x0, found.loss_seeds.astype(float)])
    correlation = np.corrcoef(pairs.T) - np.eye(5)
    assert np.abs(correlation).max() < 0.04  # 5.6 standard deviations
    assert len(set(found.loss_seeds.tolist())) == 20_000


def test_vertex_draws_are_corners_and_nominal_and_given_plants_are_constant(campaign: Few) -> None:
    scenario = campaign[1][0].scenario
    vertices = box_of(with_plant(scenario, draw="vertex")).population(0, range(200)).A
    assert set(np.round(vertices[:, 1, 0], 12)) == {-0.2, 0.2}
    nominal = box_of(with_plant(scenario, draw="nominal")).population(0, range(5)).A
    assert (nominal == nominal[0]).all()
    A, B = ((5.0, 1.0), (0.0, 2.0)), ((3.0,), (1.0,))
    given = box_of(with_plant(scenario, draw="given", A=A, B=B)).population(0, range(5))
    assert (np.array(A) == given.A).all()
    assert (np.array(B) == given.B).all()


def test_a_draw_of_a_campaign_can_be_run_as_a_scenario(campaign: Few) -> None:
    plan, points = campaign
    for point in points:
        for draw, row in enumerate(point.work.run(range(4))):
            alone = drawn_scenario(point.scenario, plan.seed, draw)
            run = run_continuous(alone)
            assert row["transmissions"] == len(run.event_s)
            assert row["deliveries"] == run.delivered.sum()
            end = run.at([alone.horizon_s]).x[0]
            assert row["final_norm"] == pytest.approx(np.linalg.norm(end), rel=1e-9)


def test_each_draw_has_its_own_window_of_a_trace() -> None:
    scenario = load(Path(__file__).parents[4] / "scenarios/lane_following.toml")
    steps_ns = tuple(k * 10**6 for k in range(1000))
    one = Replay(sent_ns=steps_ns, delays_ns=steps_ns, offset_s="random")
    network = scenario.network.model_copy(update={"loss": NoLoss(), "impairments": (one,)})
    scenario = scenario.model_copy(update={"network": network})
    begins_ms = [
        update_link_of(drawn_scenario(scenario, 5, draw)).decide(0, 1, 0).release_ns // 10**6
        for draw in range(40)
    ]
    assert len(set(begins_ms)) > 30
    assert min(begins_ms) < 200 < 800 < max(begins_ms)

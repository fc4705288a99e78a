"""Draws, and the measures of their runs in virtual time, of one loop and of several."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import run_continuous
from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.simulation.virtual_time import simulate, simulate_loops
from cosim.studies.campaign.campaign_grid import row_type
from cosim.studies.campaign.drawn_runs import LOOPS_ROW, SampledWork, SharedNetworkWork, in_virtual_time
from cosim.studies.campaign.random_draws import box_of, drawn_scenario, seeds_of
from netem.core.errors import CallerError, ExitStatus
from netem.impairments.kinds.replay import Replay
from netem.impairments.loss_models.lossless import NoLoss
from noack.machines.run_channel import channel_of
from noack.scenario.resolution import ResolvedRun, loop_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from tests.cosim.studies.campaign.conftest import Few, Write, few_of
from tests.helpers.shipped import shipped

SHIPPED = Path(__file__).parents[4] / "scenarios"
COARSE = ("horizon_s=4.0", "plant.rate_hz=50.0", "controller.rate_hz=50.0")
SPREAD = "plant.initial_state_halfwidth=[0.5, 0.1, 0.1, 2.0]"
LATE = 'network.impairments=[{kind = "delay", delay_s = 0.03}]'
NEVER = (
    "network.protocol=ack",
    "network.acknowledgements.loss.model=bernoulli",
    "network.acknowledgements.loss.probability=1.0",
)


def scenario(*overrides: str) -> Scenario:
    return shipped("lane_following", *COARSE, SPREAD, *overrides)


def work(*overrides: str, **changed: Any) -> SampledWork:
    settings: dict[str, Any] = {"Q": None, "R": None, "settle": 0.5, "most_events": 1000}
    return SampledWork(in_virtual_time(scenario(*overrides)), 7, **settings | changed)


def record_of(sampled: SampledWork, draw: int) -> RunRecord:
    return simulate(drawn_scenario(sampled.scenario, sampled.seed, draw))


@pytest.mark.parametrize(("name", "index"), [("lateral offset", 3), ("r", 1)])
def test_the_largest_output_from_a_time_on_is_that_of_the_record(name: str, index: int) -> None:
    sampled = work("controller.setpoint=[0.0, 0.0, 0.0, 2.0]", output=name, from_s=2.0)
    (row,) = sampled.run(range(1))
    steps = record_of(sampled, 0)["plant_step"]
    distances = np.abs(steps["x"][:, index] - [0.0, 0.0, 0.0, 2.0][index])
    late = steps["t_ns"] >= 2_000_000_000
    assert row["output_largest"] == pytest.approx(distances[late].max())
    assert 0 < row["output_largest"] < distances.max()
    assert "output_largest" not in (work().row_type.names or ())


def test_a_run_settles_at_its_setpoint() -> None:
    """‖x‖ stays near ‖x_r‖ = 20, so no such run settled by ‖x‖."""
    sampled = work("controller.setpoint=[0.0, 0.0, 0.0, 20.0]", "horizon_s=20.0")
    (row,) = sampled.run(range(1))
    steps = record_of(sampled, 0)["plant_step"]
    distances = np.linalg.norm(steps["x"] - [0.0, 0.0, 0.0, 20.0], axis=1)
    above = steps["t_ns"][distances > 0.5 * distances[0]]
    assert row["settling_s"] == above[-1] / 1e9
    assert row["final_norm"] == pytest.approx(20.0, rel=0.01)


@pytest.mark.parametrize("overrides", [(), (LATE,), NEVER, ("mode=zoh",)])
def test_a_row_agrees_with_the_summary_of_the_run(overrides: tuple[str, ...]) -> None:
    sampled = work(*overrides)
    for draw, row in enumerate(sampled.run(range(2))):
        record = record_of(sampled, draw)
        expected = summarise_loop(record, ExitStatus.OK, "").to_json()
        assert row["status"] == OK
        assert row["transmissions"] == expected["events"]
        assert row["deliveries"] == expected["deliveries"]
        assert row["final_norm"] == pytest.approx(expected["final_state_norm"], rel=1e-12)
        shortest_s = math.nan if expected["events"] < 2 else expected["inter_event_min_s"]
        assert row["inter_event_min_s"] == pytest.approx(shortest_s, rel=1e-12, nan_ok=True)
        norms = np.linalg.norm(record["plant_step"]["x"], axis=1)
        last_s = record["plant_step"]["t_ns"][norms > 0.5 * norms[0]][-1] * 1e-9
        settled_s = last_s if norms[-1] <= 0.5 * norms[0] else math.nan
        assert row["settling_s"] == pytest.approx(settled_s, nan_ok=True)
        # e^{0.25 t} grows from 1 to e over the horizon.
        assert expected["sup_e_c_norm"] <= row["sup_e_c_scaled"] <= np.e * expected["sup_e_c_norm"]


GUSTS = (
    'plant.disturbances=[{kind = "gaussian", std = [3.0, 1.0]},'
    ' {kind = "uniform", at = "state", bound = [0.5, 0.0, 0.0, 2.0]}]'
)


@pytest.mark.parametrize("overrides", [(), (GUSTS,)])
def test_the_cost_is_the_integral_under_the_held_inputs(overrides: tuple[str, ...]) -> None:
    """Disturbances enter the cost only through the state."""
    Q, R = np.diag([1.0, 2.0, 3.0, 4.0]), np.diag([0.5, 0.25])
    sampled = work("horizon_s=0.1", *overrides, Q=Q, R=R)
    (row,) = sampled.run(range(1))
    record = record_of(sampled, 0)
    cost = 0.0
    for step in record["plant_step"][:-1]:
        d, w = (step["d"], step["w"]) if overrides else (0.0, 0.0)
        drift = np.zeros((5, 5))
        drift[:4, :4], drift[:4, 4] = record.loop.A, record.loop.B @ (step["u"] + d) + w

        def rate(s: float, z: Any, G: Any) -> float:
            x = (expm(G * s) @ z)[:4]
            return float(x @ Q @ x)

        of_x = partial(rate, z=np.append(step["x"], 1.0), G=drift)
        cost += quad_vec(of_x, 0.0, 0.02, epsrel=1e-12)[0] + 0.02 * step["u"] @ R @ step["u"]
    assert row["cost"] == pytest.approx(cost, rel=1e-10)


def test_a_nonlinear_plant_is_drawn_and_its_cost_is_a_sum() -> None:
    scenario = load(SHIPPED / "cart_pole.toml", ["horizon_s=1.0", "plant.rate_hz=200.0"])
    sampled = SampledWork(in_virtual_time(scenario), 7, None, None, 0.5, 1000)
    (row,) = sampled.run(range(1))
    record = record_of(sampled, 0)
    steps = record["plant_step"]
    assert row["status"] == OK
    assert not record.scenario.coverage.is_linear
    of_x = (steps["x"] ** 2).sum(axis=1)
    expected = np.trapezoid(of_x, dx=0.005) + 0.005 * (steps["u"][:-1] ** 2).sum()
    assert row["cost"] == pytest.approx(expected, rel=1e-12)


def test_a_failed_run_has_the_status_of_its_failure() -> None:
    growing = "model.gain=[[0, 0, 0, 0], [0, 0, 0, 0]]"
    (row,) = work(
        growing, "model.allow_unstable=true",
        "horizon_s=2000.0", "plant.rate_hz=5.0", "controller.rate_hz=5.0",
    ).run(range(1))  # fmt: skip
    assert row["status"] == DIVERGED
    assert 0 < row["diverged_at_s"] < 2000
    assert np.isnan(row["cost"])
    (row,) = work("mode=zoh", most_events=2).run(range(1))
    assert (row["status"], np.isnan(row["cost"])) == (TOO_MANY_EVENTS, True)


AXIS = {"name": "number", "key": "loops.0.count", "values": [1, 3]}


def shared_work(*overrides: str, **settings: Any) -> SharedNetworkWork:
    scenario = in_virtual_time(shipped("shared_bottleneck", "horizon_s=2.0", *overrides))
    measured: dict[str, Any] = {"Q": None, "R": None, "settle": 0.5, "most_events": 1000}
    return SharedNetworkWork(scenario, 7, **measured | settings)


def test_a_row_agrees_with_the_summaries_of_the_loops() -> None:
    loops_work = shared_work("network.impairments=[]", "loops.0.count=2")
    rows = loops_work.run(range(2))
    assert rows.dtype == LOOPS_ROW
    seeds = seeds_of(loops_work.seed, 1)
    shared = simulate_loops(ResolvedRun(loops_work.scenario.model_copy(update={"seeds": seeds})))
    loops = [summarise_loop(record, 0, "").to_json() for record in shared.loops]
    row = rows[1]
    assert row["transmissions"] == sum(loop["events"] for loop in loops) != rows[0]["transmissions"]
    assert row["deliveries"] == sum(loop["deliveries"] for loop in loops)
    assert row["longest_loss_burst"] == max(loop["longest_loss_burst"] for loop in loops)
    assert row["final_norm"] == pytest.approx(max(loop["final_state_norm"] for loop in loops))
    assert 0 < row["cost"] < row["cost_worst"]
    assert row["loops_failed"] == 0


def test_a_loop_that_diverges_costs_an_infinite_amount_and_is_counted() -> None:
    own = "A = [[0.0, 1.0], [900.0, 0.0]], B = [[0.0], [1.0]]"
    wild = f'{{ name = "wild", plant = {{ draw = "given", {own} }} }}'
    loops_work = shared_work(
        "horizon_s=30", f'loops=[{{ name = "calm", count = 3 }}, {wild}]', most_events=400
    )
    (row,) = loops_work.run(range(1))
    assert row["loops_failed"] == 0.25
    assert np.isnan(row["cost"])


def test_the_number_of_loops_is_an_axis(write: Write, plan: dict[str, Any]) -> None:
    sampled: dict[str, Any] = {"time": "sampled", "compare": None, "figures": []}
    loops = {"loops": [{"name": "loop"}]}
    _, points = few_of(write(plan, axes=[AXIS], settings=loops, **sampled))
    assert [point.scenario.loops[0].count for point in points] == [1, 3]
    assert row_type(points) == LOOPS_ROW
    assert [type(point.work) for point in points] == [SharedNetworkWork, SharedNetworkWork]
    with pytest.raises(CallerError, match='needs time = "sampled"'):
        few_of(write(plan, axes=[AXIS], settings=loops, **sampled | {"time": "continuous"}))
    some = {"name": "some", "variants": {"one": {"mode": "zoh"}, "two": loops}}
    with pytest.raises(CallerError, match="either all grid points have loops, or none has"):
        few_of(write(plan, axes=[some], **sampled))


def with_plant(scenario: Scenario, **changed: object) -> Scenario:
    plant = scenario.plant.model_copy(update=changed)
    return scenario.model_copy(update={"plant": plant})


def test_draws_depend_neither_on_the_chunk_nor_on_the_grid_point(campaign: Few) -> None:
    first, *others = (point.work.box for point in campaign[1])
    whole = first.population(11, range(9))
    parts = [(slice(3, 5), first.population(11, range(3, 5)))]
    parts += [(slice(0, 9), box.population(11, range(9))) for box in others]
    for place, part in parts:
        for values, expected in zip(part, whole, strict=True):
            np.testing.assert_array_equal(values, expected[place])
    assert first.population(11, range(10**8, 10**8 + 1)).x0.shape == (1, 2)


def test_plants_are_drawn_uniformly_in_the_box(campaign: Few) -> None:
    point = campaign[1][0]
    population = point.work.box.population(11, range(20_000))
    centre, half = loop_of(drawn_scenario(with_plant(point.scenario, draw="nominal"), 0, 0)), 0.2
    off = population.A[:, 1, 0] - centre.A[1, 0]
    assert np.abs(off).max() <= half
    # The standard deviation of a mean of 20,000 is below 0.001, that of a variance below 0.0001.
    assert abs(off.mean()) < 0.005
    assert off.var() == pytest.approx(half**2 / 3, abs=0.0005)
    np.testing.assert_array_equal(population.A[:, 0], np.broadcast_to(centre.A[0], (20_000, 2)))
    pairs = np.column_stack([off, population.A[:, 1, 1], population.x0, population.loss_seeds.astype(float)])
    correlation = np.corrcoef(pairs.T) - np.eye(5)
    assert np.abs(correlation).max() < 0.04  # 5.6 standard deviations
    assert len(set(population.loss_seeds.tolist())) == 20_000


def test_vertex_draws_are_corners_and_nominal_and_given_plants_are_constant(campaign: Few) -> None:
    scenario = campaign[1][0].scenario
    vertices = box_of(with_plant(scenario, draw="vertex")).population(0, range(200)).A
    assert set(np.round(vertices[:, 1, 0], 12)) == {-0.2, 0.2}
    nominal = box_of(with_plant(scenario, draw="nominal")).population(0, range(5)).A
    assert (nominal == nominal[0]).all()
    A, B = ((5.0, 1.0), (0.0, 2.0)), ((3.0,), (1.0,))
    population = box_of(with_plant(scenario, draw="given", A=A, B=B)).population(0, range(5))
    assert (np.array(A) == population.A).all()
    assert (np.array(B) == population.B).all()


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
    scenario = load(SHIPPED / "lane_following.toml")
    steps_ns = tuple(k * 10**6 for k in range(1000))
    replay = Replay(sent_ns=steps_ns, delays_ns=steps_ns, offset_s="random")
    network = scenario.network.model_copy(update={"loss": NoLoss(), "impairments": (replay,)})
    scenario = scenario.model_copy(update={"network": network})
    begins_ms = [
        channel_of(drawn_scenario(scenario, 5, draw)).links[0].decide(0, 1, 0).release_ns // 10**6
        for draw in range(40)
    ]
    assert len(set(begins_ms)) > 30
    assert min(begins_ms) < 200 < 800 < max(begins_ms)

"""Unknown constant loads: gains, the model's states, the observer, and mistakes."""

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate, simulate_loops
from netem.core.errors import CallerError
from netem.core.settings_section import Table
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.loads import load_gains
from noack.scenario.resolution import loop_of, resolve, resolve_run, setpoint_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.helpers.shipped import resolved, shipped

MASS: Table = {
    "name": "mass",
    "horizon_s": 20.0,
    "model": {
        "A": [[0.0, 1.0], [0.0, 0.0]],
        "B": [[0.0], [1.0]],
        "gain": [[-1.0, -1.5]],
        "state_names": ["position", "velocity"],
    },
    "plant": {"initial_state": [1.0, 0.0], "rate_hz": 100.0},
    "trigger": {"beta": 0.2, "alpha_per_s": 0.2, "floor": 0.01},
    "controller": {"rate_hz": 100.0},
    "network": {"mansd": 3, "loss": {"model": "bernoulli", "probability": 0.5}},
}


def mass(**tables: Table) -> Scenario:
    """Return a mass driven by a force, with further keys of some tables."""
    content = {
        key: MASS.get(key, {}) | tables[key] if key in tables else MASS[key] for key in {**MASS, **tables}
    }
    return validate(content, "mass")


def last_x(run: RunRecord, n: int) -> Vector:
    return np.asarray(run[PLANT_STEP]["x"][-1][:n])


def test_a_load_at_the_input_is_subtracted_from_the_input() -> None:
    model = resolve(mass(model={"load": "input"})).model
    assert model.A == ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    assert model.gain == ((-1.0, -1.5, -1.0),)
    assert model.state_names == ("position", "velocity", "load")


def test_a_torque_on_a_motor_is_compensated_by_the_voltage_that_the_equations_at_rest_give() -> None:
    loop = loop_of(resolved("dc_motor", "model.load=[[0.0],[309.4],[0.0]]", 'model.hold=["shaft_angle"]'))
    # at rest: the current holds the torque, i = −309.4 / 8487.18, and the voltage drives it, u = R i
    current = -309.4 / 8487.176310246561
    voltage = 1454545.4545454546 / 363636.36363636365 * current
    rest = np.array([0.0, 0.0, current, 1.0])
    np.testing.assert_allclose(loop.A_model @ rest + loop.B_model[:, 0] * voltage, 0.0, atol=1e-9)
    np.testing.assert_allclose(loop.K @ rest, voltage, rtol=1e-9)


def test_the_gains_of_random_loads_solve_the_regulator_equations() -> None:
    generator = np.random.default_rng(3)
    for _ in range(20):
        A, B, E = (generator.standard_normal((3, columns)) for columns in (3, 2, 1))
        model = mass().model.model_copy(update={
            "A": tuple(map(tuple, A)), "B": tuple(map(tuple, B)), "gain": ((0.0,) * 3,) * 2,
            "state_names": ("a", "b", "c"), "hold": ("b",), "load": tuple(map(tuple, E)),
        })  # fmt: skip
        _, gain, rest = load_gains(model)
        np.testing.assert_allclose(A @ rest + B @ gain + E, 0.0, atol=1e-9)
        assert abs(rest[1, 0]) < 1e-9


@pytest.mark.parametrize("name", ["dc_motor_load", "lane_crosswind_load"])
def test_the_loop_comes_to_rest_within_the_threshold_and_nothing_is_sent(name: str) -> None:
    run = simulate(resolved(name))
    rows, tests = run[PLANT_STEP], run[SENSOR_MEASUREMENT]
    sent_ns = tests["t_ns"][tests["event"] >= 0]
    assert len(sent_ns) < 20
    assert sent_ns[-1] < 0.75 * run.scenario.timing.horizon_ns
    assert np.linalg.norm(rows["x"][-1][: run.scenario.model.plant_states]) < run.scenario.decaying.floor
    np.testing.assert_allclose(tests["x"][-1], rows["x"][-1], atol=1e-3)


def test_without_the_load_in_the_model_the_offset_stays_and_packets_never_cease() -> None:
    step = {"kind": "step", "at": "input", "amplitude": [0.5]}
    without = simulate(resolve(mass(plant={"disturbances": [step]})))
    with_load = simulate(resolve(mass(model={"load": "input"}, plant={"load": [0.5]})))
    assert last_x(without, 2)[0] == pytest.approx(0.5, abs=0.1)  # force over stiffness
    assert abs(last_x(with_load, 2)[0]) < 0.02
    events = [int((run[SENSOR_MEASUREMENT]["event"] >= 0).sum()) for run in (without, with_load)]
    assert events[1] < events[0] / 4


def test_what_sensor_and_controller_know_at_the_start_has_no_load() -> None:
    scenario = mass(model={"load": "input"}, plant={"load": [0.5]}, network={"initial_sync": "known_state"})
    run = simulate(resolve(scenario))
    assert run[CONTROLLER_STEP]["x_c"][0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-2)
    assert abs(last_x(run, 2)[0]) < 0.02
    assert replay(run).bit_exact


def test_a_load_may_change_during_the_run() -> None:
    change = [{"at_s": 4.0, "load": [-0.3]}]
    run = simulate(resolve(mass(model={"load": "input"}, plant={"load": [0.5], "load_changes": change})))
    load = run[PLANT_STEP]["x"][:, 2]
    assert load[400] == pytest.approx(0.5)
    assert load[401] == pytest.approx(-0.3)
    assert run[SENSOR_MEASUREMENT]["x"][-1][2] == pytest.approx(-0.3, abs=1e-3)
    assert replay(run).bit_exact


def test_loads_are_drawn_within_their_half_widths() -> None:
    plant = {"load": [0.5], "load_halfwidth": [0.2]}
    loads = [
        resolve(
            mass(model={"load": "input"}, plant=plant, seeds={"initial_state": seed})
        ).plant.initial_state[2]
        for seed in range(50)
    ]
    assert 0.3 < min(loads) < 0.36
    assert 0.64 < max(loads) < 0.7


def test_a_set_point_has_the_states_of_the_plant() -> None:
    run = simulate(
        resolve(mass(model={"load": "input"}, plant={"load": [0.5]}, controller={"setpoint": [2.0, 0.0]}))
    )
    assert setpoint_of(run.scenario)[0].tolist() == [2.0, 0.0, 0.0]
    assert last_x(run, 2)[0] == pytest.approx(2.0, abs=0.02)


def test_a_resolved_scenario_is_the_same_when_it_is_resolved_again() -> None:
    once = resolved("lane_crosswind_load")
    again = resolve(validate(once.content(), "again"))
    assert again == once


def test_a_plant_with_friction_stops_nearer_to_its_set_point() -> None:
    """Coulomb friction is a load that changes its sign: the observer takes it for one."""
    without, with_load = shipped("dc_motor"), shipped("dc_motor", 'model.load="input"')
    ends = [abs(last_x(simulate(resolve(scenario)), 1)[0]) for scenario in (without, with_load)]
    assert ends[1] < ends[0] / 2


def test_several_loops_have_loads_of_their_own() -> None:
    loops = [{"name": "one", "count": 2}, {"name": "two", "plant": {"load": [0.1]}}]
    content = MASS | {
        "model": MASS["model"] | {"load": "input"},
        "plant": MASS["plant"] | {"load": [0.5]},
        "loops": loops,
    }  # type: ignore[operator]
    run = simulate_loops(resolve_run(validate(content, "mass")))
    assert [loop[PLANT_STEP]["x"][0][2] for loop in run.loops] == [0.5, 0.5, 0.1]


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        (
            {"model": {"load": [[1.0], [0.0]]}},
            "the input cannot cancel this load in every state; name in model.hold",
        ),
        (
            {"model": {"load": [[1.0], [0.0]], "hold": ["velocity"]}},
            "no constant input holds velocity at 0 under the load; name other states",
        ),
        (
            {"model": {"load": "input", "state_names": ["load", "speed"]}},
            "load occurs more than once in load, speed, load",
        ),
        ({"plant": {"load": [1.0]}}, "plant.load = [1.0]: the model has no load; give model.load"),
        ({"model": {"load": "input"}, "plant": {"load": [1.0, 2.0]}}, "expected 1 entries (one per load)"),
        ({"model": {"load": [[1.0, 0.0]]}}, "expected 2 x 2 (one row per state, one column per load)"),
        ({"model": {"hold": ["position"]}}, "it names the states that stay at 0 under a load"),
        (
            {"model": {"load": "input", "hold": ["angle"]}},
            "no state is named angle; they are position, velocity",
        ),
        (
            {"model": {"load": "input"}, "trigger": {"policy": "relative", "sigma": 0.1}},
            "a load is not small",
        ),
    ],
)
def test_a_mistake_is_explained_in_one_line(tables: dict[str, Table], message: str) -> None:
    if "trigger" in tables:
        content = MASS | {"model": MASS["model"] | tables["model"], "trigger": tables["trigger"]}  # type: ignore[operator]
        with pytest.raises(CallerError, match="a load is not small") as raised:
            validate(content, "mass")
    else:
        with pytest.raises(CallerError) as raised:
            mass(**tables)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


SPRING = {"A": [[0.0, 1.0], [-1.0, -1.0]], "B": [[0.0], [1.0]], "gain": [[-1.0, -1.0]]}


@pytest.mark.parametrize(
    ("model", "C", "message"),
    [
        # A constant force on a mass at a spring: only its position moves in the long run.
        ({**SPRING, "load": "input"}, [[0.0, 1.0]], "this load cannot be estimated from what"),
        ({**SPRING, "load": [[0.0, 0.0], [1.0, 2.0]], "hold": ["position"]}, [[0.0, 1.0]],
         "none of these loads can be estimated from what"),
        # Two loads on a mass: only their effect together is seen.
        ({"load": [[1.0, 0.0], [0.0, 1.0]], "hold": ["position"]}, [[1.0, 0.0]],
         "cannot tell the loads apart from what .*; measure more states, or take fewer loads than 2"),
        ({"load": "input"}, [[0.0, 1.0]], "C does not determine the model's states, so no load can be"),
    ],
)  # fmt: skip
def test_a_load_that_no_observer_can_estimate_is_refused(
    model: dict[str, object], C: list[list[float]], message: str
) -> None:
    with pytest.raises(CallerError, match=rf"^model\.load: .*{message}") as refused:
        resolve(mass(model=model, plant={"measurement": {"C": C}}))
    assert "\n" not in str(refused.value)

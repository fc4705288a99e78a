"""The checker reads a resolved scenario as noack does."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, fmpq

from cosim.analysis.witnesses import resolved_content
from netem.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.proof.elaborate.errors import RefusedError
from noack.proof.elaborate.keys import key_table, refusals
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.scenario import output_names, read_loop
from noack.scenario.resolution import loop_of, resolve, rule_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import about_reference, allowed_conditions, ideal_conditions
from tests.helpers.resolved_tables import first_loop, resolved_tables, tables_of
from tests.helpers.shipped import resolved, shipped

SCENARIOS = Path(__file__).parents[2] / "scenarios"
LOADED = {"dc_motor_load", "lane_crosswind_load"}
"""tests/checker/test_loads.py has those with loads."""
NAMES = sorted({file.stem for file in SCENARIOS.glob("*.toml")} - LOADED)
REFUSED = {
    "cart_pole", "dc_motor", "four_tank", "friction_servo", "kinematic_car", "lane_acknowledged",
    "lane_python_trigger", "model_predictive", "quadrotor_hover", "saturated_lqr",
    "sine_pendulum",
}  # fmt: skip
NOT_IDEAL = {"tabuada_dynamic", "pendulum_observed"}
"""Their rule, or observer, needs tests at times."""


def floats(M: arb_mat) -> Matrix:
    return np.array([[float(M[i, j].mid()) for j in range(M.ncols())] for i in range(M.nrows())]).reshape(
        M.nrows(), M.ncols()
    )


def square(M: Matrix) -> Matrix:
    return np.asarray(M.T @ M)


def times_ns(loop: Loop) -> list[fmpq]:
    return [time * 10**9 for time in loop.times[:5]]


def conditions_ns(resolved: Scenario) -> list[int]:
    """Return the times of noack's conditions."""
    conditions, rule = allowed_conditions(resolved), rule_of(resolved)
    sampling_s, least_s = conditions.sampling_s, conditions.spacing_s or conditions.apart_s
    if rule.grid_ns:
        sampling_s = rule.grid_ns * 1e-9
        least_s = least_s if rule.longest_ns % rule.grid_ns and rule.longest_ns < np.inf else sampling_s
    assert conditions.lead_s == 0.0
    times_s = (sampling_s, least_s, conditions.delay_s, conditions.hold_s, conditions.start_s)
    return [round(time_s * 1e9) for time_s in times_s]


def form_of(loop: Loop, M: Matrix) -> Matrix:
    """Return a rule's form of (x, e_s); that of a rule "of_input" is one of (x, K e_s)."""
    if not loop.rule.of_input:
        return M
    n, K = loop.n, floats(loop.gain)
    seen = np.block([[np.eye(n), np.zeros((n, n))], [np.zeros((len(K), n)), K]])
    return np.asarray(seen.T @ M @ seen)


def require_same(loop: Loop, resolved: Scenario) -> None:
    """Compare what does not depend on the plants of the statement."""
    matrices, rule, n = loop_of(resolved), rule_of(resolved), loop.n
    np.testing.assert_array_equal(floats(loop.model_A), matrices.A_model)
    np.testing.assert_array_equal(floats(loop.model_B), matrices.B_model)
    np.testing.assert_array_equal(floats(loop.gain), matrices.K)
    np.testing.assert_array_equal(
        floats(loop.weight), np.eye(n) if matrices.weight is None else matrices.weight
    )
    assert loop.holds is (resolved.mode == "zoh")
    x_0 = loop_of(about_reference(resolved)).x0
    np.testing.assert_allclose(floats(loop.start)[:, 0], x_0, rtol=1e-15)
    assert loop.losses == ideal_conditions(resolved).dropouts
    P, N = rule.form
    form = form_of(loop, square(floats(loop.rule.positive)) - square(floats(loop.rule.negative)))
    np.testing.assert_allclose(form, square(P) - square(N), atol=1e-12 * max(np.abs(form).max(), 1.0))
    assert float(loop.rule.level) == rule.level
    assert float(loop.rule.rate) == rule.rate_per_s
    assert float(loop.rule.floor) == pytest.approx(rule.floor, rel=1e-15)
    if (dynamic := rule.dynamic_variable) is not None:
        memory, (P, N) = loop.rule.memory, dynamic.gain
        assert memory is not None
        gain = form_of(loop, floats(memory.gain))
        np.testing.assert_allclose(gain, square(P) - square(N), atol=1e-12 * np.abs(gain).max())
        assert (float(memory.decay), float(memory.start)) == (dynamic.decay_per_s, dynamic.initial)
    is_compared = len(rule.form.positive) > 0
    idle_ns = max(rule.idle_ns, 0) if is_compared else 0
    step_ns = int(loop.times.sampling * 10**9) or 1  # 0: tests at all times
    assert loop.times.dwell * 10**9 == -(-idle_ns // step_ns) * step_ns
    assert loop.rule.always is (is_compared and rule.longest_ns < np.inf)
    period_ns = 0 if is_compared else rule.latest_ns(resolved.timing.measurement_period_ns)
    assert loop.times.period == loop.times.least_period == fmpq(int(period_ns), 10**9)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_scenarios_are_read_as_noack_reads_them(name: str) -> None:
    try:
        resolved = first_loop(name)
    except CallerError as error:
        pytest.skip(str(error))
    tables = tables_of(resolved)
    if name in REFUSED:
        with pytest.raises(RefusedError, match=refusals(tables)[0].partition(" ")[0]):
            read_loop(tables, box=False, ideal=False)
        return
    own = read_loop(tables, box=False, ideal=False)
    require_same(own, resolved)
    assert times_ns(own) == conditions_ns(resolved)
    np.testing.assert_array_equal(floats(own.A), loop_of(resolved).A)
    np.testing.assert_array_equal(floats(own.B), loop_of(resolved).B)
    assert not floats(own.half_A).any()
    if name in NOT_IDEAL:
        with pytest.raises(RefusedError, match=r"trigger\.policy|observer"):
            read_loop(tables, box=False, ideal=True)
        return
    ideal = read_loop(tables, box=False, ideal=True)
    assert list(ideal.times[:5]) == [fmpq(round(rule_of(resolved).grid_ns), 10**9)] * 2 + [fmpq(0)] * 3
    box, plant = read_loop(tables, box=True, ideal=False), resolved.plant
    require_same(box, resolved)
    np.testing.assert_array_equal(floats(box.A), loop_of(resolved).A_model)
    for half, given in ((box.half_A, plant.uncertainty_A), (box.half_B, plant.uncertainty_B)):
        assert floats(half).any() == (given is not None and np.any(given))
        assert given is None or (floats(half) == np.array(given)).all()


Q = "[[-0.04, 0.01, 0, 0], [0.01, -0.02, 0, 0.3], [0, 0, 1, -0.2], [0, 0.3, -0.2, 2]]"
INNER = f'{{policy="quadratic", Q={Q}, epsilon=0.01, period_s=0.01, heartbeat=0}}'
TRIGGERS = (
    'policy="absolute", delta=0.1, weight=[[2.0, 1.0], [0.0, 1.0]]',
    'policy="relative", sigma=0.2, weight=[[2.0, 1.0], [0.0, 1.0]]',
    'policy="mixed", sigma=0.2, epsilon=0.03',
    f'policy="quadratic", Q={Q}, epsilon=0.01, period_s=0.01, heartbeat=7',
    'policy="periodic", period_s=0.1',
    'policy="dynamic", sigma=0.2, theta_s=0.5, decay_per_s=0.3, eta_0=0.1, Q=[[2.0, 0.1], [0.1, 1.0]]',
    'policy="dwell", interval_s=0.0991, rule={policy="mixed", sigma=0.2, epsilon=0.03}',
    'policy="dwell", interval_s=0.3, rule={policy="periodic", period_s=0.1}',
    'policy="deadline", interval_s=0.5, rule={policy="decaying", beta=0.1, alpha_per_s=0.2, floor=0.001}',
    'policy="deadline", interval_s=0.5, rule={policy="periodic", period_s=0.8}',
    f'policy="deadline", interval_s=0.505, rule={INNER}',
    f'policy="deadline", interval_s=0.5, rule={{policy="deadline", interval_s=0.7, rule={INNER}}}',
)


@pytest.mark.parametrize("trigger", TRIGGERS)
def test_rules_are_those_of_noack(trigger: str) -> None:
    resolved = first_loop("double_integrator", f"trigger={{{trigger}}}")
    loop = read_loop(tables_of(resolved), box=False, ideal=False)
    require_same(loop, resolved)
    assert times_ns(loop)[2:] == conditions_ns(resolved)[2:]
    assert times_ns(loop)[0] == conditions_ns(resolved)[0]
    assert times_ns(loop)[1] <= conditions_ns(resolved)[1]


@pytest.mark.parametrize("interval_s", [0.5, 0.501])
def test_an_event_is_due_no_sooner_than_at_the_deadline(interval_s: float) -> None:
    trigger = f'policy="deadline", interval_s={interval_s}, rule={{policy="absolute", delta=0.1}}'
    tables = tables_of(first_loop("double_integrator", f"trigger={{{trigger}}}"))
    times = read_loop(tables, box=False, ideal=False).times
    assert fmpq(1, 2) <= times.due <= times.longest
    assert float(arb(times.due)) >= interval_s
    assert read_loop(tables, box=False, ideal=True).times.due == fmpq(round(1000 * interval_s), 1000)
    undue = tables_of(first_loop("double_integrator", 'trigger={policy="absolute", delta=0.1}'))
    assert read_loop(undue, box=False, ideal=False).times.due == 0


def test_constraints_can_lower_the_most_losses() -> None:
    settings = 'network.constraints=[{kind="at_most", losses=2, window=10}, {kind="recovery", deliveries=3}]'
    resolved = first_loop("double_integrator", settings, "network.mansd=4")
    assert read_loop(tables_of(resolved), box=False, ideal=False).losses == 2
    require_same(read_loop(tables_of(resolved), box=False, ideal=True), resolved)


DISTURBANCES = (
    'plant.disturbances=[{kind="uniform", bound=[0.3]}, {kind="sine", at="state", amplitude=[0.5, -1.0], '
    'hz=3.0}, {kind="uniform", at="state", bound=[0.0, 0.2]}, {kind="step", amplitude=[1.5]}]'
)


def test_disturbances_are_columns_of_what_they_add() -> None:
    resolved = first_loop("double_integrator", DISTURBANCES)
    loop = read_loop(tables_of(resolved), box=False, ideal=False)
    B = loop_of(resolved).B
    expected = np.hstack([0.3 * B, [[0.5], [-1.0]], [[0.0], [0.2]], 1.5 * B])
    np.testing.assert_allclose(floats(loop.pushes), expected, rtol=1e-15)
    assert [float(size) for size in loop.sizes] == [1.0] * 4


def test_a_disturbance_of_the_input_acts_through_each_B_of_the_box() -> None:
    settings = ("plant.uncertainty_B=[[0.0], [0.25]]", 'plant.disturbances=[{kind="step", amplitude=[-2.0]}]')
    resolved = first_loop("double_integrator", *settings)
    loop = read_loop(tables_of(resolved), box=True, ideal=False)
    model_B = loop_of(resolved).B_model
    np.testing.assert_allclose(floats(loop.pushes), np.hstack([-2.0 * model_B, [[0.0], [0.5]]]))


def test_the_setpoint_is_moved_to_0_until_the_first_input_its_input_is_missing() -> None:
    resolved = first_loop("unstable_pendulum", "controller.setpoint=[0.1, 0.0]", 'plant.draw="nominal"')
    loop = read_loop(tables_of(resolved), box=False, ideal=False)
    np.testing.assert_allclose(floats(loop.start)[:, 0], about_reference(resolved).plant.initial_state)
    u_r = -9.81 * 0.1
    assert loop.push_before_input is not None
    np.testing.assert_allclose(floats(loop.push_before_input)[:, 0], [0.0, -u_r])
    assert loop.until is None
    assert np.abs(floats(loop.pushes)).max(initial=0.0) < 1e-9  # the model rests there, up to rounding


def test_plants_of_a_box_are_pushed_where_they_do_not_rest() -> None:
    uncertain = ("controller.setpoint=[2.0, 0.0]", "plant.uncertainty_A=[[0.1, 0.0], [0.0, 0.0]]")
    loop = read_loop(tables_of(first_loop("double_integrator", *uncertain)), box=True, ideal=False)
    assert np.abs(floats(loop.pushes)).sum(axis=1) == pytest.approx([0.2, 0.0])


def test_a_setpoint_itself_is_refused() -> None:
    tables = tables_of(first_loop("double_integrator"))
    tables["controller"]["setpoint"] = [2.0, 0.0]
    with pytest.raises(RefusedError, match=r"controller.setpoint = .*: a resolved scenario has it as"):
        read_loop(tables, box=False, ideal=False)


def test_a_watchdog_that_may_act_is_refused() -> None:
    settings = ("plant.watchdog.policy=zero", "plant.watchdog.timeout_s=0.004")
    with pytest.raises(RefusedError, match=r"plant.watchdog.timeout_s = 0.004"):
        read_loop(resolved_tables("double_integrator", *settings), box=False, ideal=False)
    read_loop(resolved_tables("double_integrator", settings[0]), box=False, ideal=False)


def test_a_watchdog_that_may_act_on_inputs_from_the_network_is_refused() -> None:
    """With predictions "hold" applies the last one, also if it is not due."""
    settings = ("network.actuation.mansd=2", "controller.predictions=4", "controller.rate_hz=50")
    for policy, timeout_s, least_s in (("hold", 0.059, 0.06), ("model", 0.065, 0.066)):
        chosen = (*settings, f"plant.watchdog.policy={policy}", "plant.watchdog.timeout_s=0.5")
        tables = resolved_tables("double_integrator", *chosen)
        read_loop(tables, box=False, ideal=False)
        tables["plant"]["watchdog"]["timeout_s"] = timeout_s
        with pytest.raises(RefusedError, match=f"may be {least_s:g}"):
            read_loop(tables, box=False, ideal=False)


ACTUATIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "no limit of losses": (("network.actuation={}",), r"network.actuation.mansd: missing"),
    "a jitter": (
        ('network.actuation={mansd=1, impairments=[{kind="delay", delay_s=0.01, jitter_s=0.001}]}',),
        r"network.actuation.impairments: delay: the delay is not constant",
    ),
}


@pytest.mark.parametrize("case", ACTUATIONS)
def test_inputs_from_the_network_whose_age_has_no_bound_are_refused(case: str) -> None:
    settings, message = ACTUATIONS[case]
    with pytest.raises(RefusedError, match=message):
        read_loop(resolved_tables("double_integrator", *settings), box=False, ideal=False)
    read_loop(resolved_tables("double_integrator", *settings), box=False, ideal=True)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("plant", "rate_hz"), 0.0, "plant.rate_hz: not from 1e-6 to 1e5"),
        (("plant", "rate_hz"), "fast", "plant.rate_hz: not a number"),
        (("plant", "A"), [[0.0, 1.0], [0.0]], "plant.A: rows of different lengths"),
        (("plant", "A"), [[0.0, 1.0]], "plant.A: not 2 x 2"),
        (("plant", "initial_state"), [1.0], "plant.initial_state: not 2 numbers"),
        (("model", "gain"), [[float("inf"), 1.0]], "model.gain: not finite"),
        (("plant", "uncertainty_B"), [[0.0], [-0.1]], "plant.uncertainty_B: below 0"),
        (("network", "mansd"), 1.5, "network.mansd: not a whole number"),
        (("trigger", "beta"), -1.0, "trigger.beta: below 0"),
        (("trigger", "weight"), [[1.0]], "trigger.weight: not 2 x 2"),
        (("certificate", "late_periods"), True, "certificate.late_periods: not a number"),
        (("network", "initial_sync"), "soon", "network.initial_sync: not one of first_packet, known_state"),
        (
            ("network", "constraints"),
            [{"kind": "at_most", "losses": 0, "window": 0}],
            "network.constraints.window: below 1",
        ),
        (
            ("plant", "disturbances"),
            [{"at": "input", "amplitude": [1.0]}],
            "plant.disturbances.kind: missing",
        ),
        (
            ("network", "impairments"),
            [{"kind": "delay", "delay_s": 10.0}],
            "certificate.network_delay_s: the network delays each update by more",
        ),
    ],
)
def test_wrong_values_are_said_in_a_line(place: tuple[str, str], value: object, message: str) -> None:
    tables = resolved_tables("double_integrator")
    tables["certificate"]["network_delay_s"] = 0.0
    tables[place[0]][place[1]] = value
    with pytest.raises(RefusedError) as caught:
        read_loop(tables, box=False, ideal=False)
    assert str(caught.value) == message


@pytest.mark.parametrize("period_s", [0.0, 1e-10, 0.001, 0.015])
def test_a_grid_that_is_none_of_measurements_is_refused(period_s: float) -> None:
    """A grid of 0 was read as tests at all times."""
    rows = "[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]"
    trigger = f'trigger={{policy="quadratic", period_s=0.02, Q=[{rows}], epsilon=0.01}}'
    tables = resolved_tables("double_integrator", trigger, "plant.rate_hz=100")
    for ideal in (True, False):
        read_loop(tables, box=False, ideal=ideal)
        wrong = {**tables, "trigger": {**tables["trigger"], "period_s": period_s}}
        with pytest.raises(RefusedError, match=r"trigger\.period_s: (not a multiple|below 1 ns)"):
            read_loop(wrong, box=False, ideal=ideal)


class Recorded(dict[str, Any]):
    """A table that records which of its keys are read."""

    def __init__(self, table: dict[str, Any], read: set[str], prefix: str = "") -> None:
        super().__init__()
        self.read, self.prefix = read, prefix
        for key, value in table.items():
            self[key] = self._recorded(key, value)

    def _recorded(self, key: str, value: object) -> object:
        prefix = "trigger." if f"{self.prefix}{key}" == "trigger.rule" else f"{self.prefix}{key}."
        if isinstance(value, dict):
            return Recorded(value, self.read, prefix)
        if isinstance(value, list):
            return [
                Recorded(entry, self.read, prefix) if isinstance(entry, dict) else entry for entry in value
            ]
        return value

    def __getitem__(self, key: str) -> Any:
        self.read.add(f"{self.prefix}{key}")
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        self.read.add(f"{self.prefix}{key}")
        return super().get(key, default)


def test_the_keys_that_the_table_calls_used_are_those_that_are_read() -> None:
    read: set[str] = set()
    constraint = 'network.constraints=[{kind="at_most", losses=2, window=10}]'
    identity = "plant.measurement.C=[[1.0, 0.0], [0.0, 1.0]]"
    box = ("plant.uncertainty_A=[[0.1, 0.0], [0.0, 0.0]]", "plant.uncertainty_B=[[0.0], [0.25]]")
    forecast = "growth_per_s=1, mismatch_per_s=1, shortest_s=0.1, longest_s=0.5"
    others = (
        f'policy="self_triggered", beta=0.1, alpha_per_s=0.2, {forecast}',
        'policy="decaying", beta=0.1, alpha_per_s=0.2',
        'policy="send_on_area", delta_s=0.1',
    )
    for trigger in (*TRIGGERS, *others):
        settings = (f"trigger={{{trigger}}}", constraint, identity, DISTURBANCES, *box)
        tables = resolved_tables("double_integrator", *settings, "plant.watchdog.policy=zero")
        read_loop(Recorded(tables, read), box=True, ideal=False)
    outputs = 'outputs=[{name="position", row=[1.0, 0.0]}]'
    tables = resolved_tables("double_integrator", "controller.setpoint=[2.0, 0.0]", outputs)
    read_loop(Recorded(tables, read), box=False, ideal=False)
    observer = 'observer={kind="luenberger", poles_per_s=[-8, -10], initial_estimate=[1.0, 0.0]}'
    settings = (observer, "plant.measurement.noise_bound=[0.1, 0.1]", "plant.draw=given")
    plant = ("plant.A=[[0.0, 1.0], [0.0, 0.0]]", "plant.B=[[0.0], [1.0]]")
    tables = resolved_tables("double_integrator", *settings, *plant)
    read_loop(Recorded(tables, read), box=False, ideal=False)
    read_loop(Recorded(resolved_tables("pendulum_observed"), read), box=False, ideal=False)
    inputs = (
        'network.actuation={mansd=3, constraints=[{kind="at_most", losses=2, window=9}], impairments=[DELAY]}'
    )
    settings = (inputs.replace("DELAY", '{kind="delay", delay_s=0.01}'), "controller.predictions=2")
    read_loop(Recorded(resolved_tables("double_integrator", *settings), read), box=False, ideal=False)
    for name in ("dc_motor_load", "servo_reference"):
        read_loop(Recorded(resolved_tables(name), read), box=False, ideal=False)
    used = {key for key, (row, *_) in key_table().rows.items() if row.use == "used"}
    assert used <= read | {"network.initial_sync"}
    refused = {key for key, (row, *_) in key_table().rows.items() if row.use == "refused"}
    inner = {key.removesuffix(".*") for key in key_table().rows}
    assert {key for key in read if key in inner} - refused - used <= {
        "network.impairments",
        "network.actuation.impairments",
    }


def test_the_outputs_of_a_scenario_are_rows_with_names() -> None:
    tables = resolved_tables("unstable_pendulum", 'outputs=[{name="tip", row=[0.5, 0.1]}, {name="rate"}]')
    loop = read_loop(tables, box=False, ideal=False)
    np.testing.assert_array_equal(floats(loop.output_rows), [[0.5, 0.1], [0.0, 1.0]])
    assert output_names(tables) == ["tip", "rate"]
    states = resolved_tables("unstable_pendulum")
    del states["outputs"]
    np.testing.assert_array_equal(floats(read_loop(states, box=False, ideal=False).output_rows), np.eye(2))
    assert output_names(states) == ["angle", "rate"]
    tables["outputs"][0]["row"] = [0.5]
    with pytest.raises(RefusedError, match=r"outputs\.row: not 2 numbers"):
        read_loop(tables, box=False, ideal=False)


@pytest.mark.parametrize("name", ["reactor_petc", "tabuada_dynamic"])
@pytest.mark.parametrize("change", [1.0, 1e-9])
def test_a_trigger_whose_matrix_is_not_symmetric_is_refused(name: str, change: float) -> None:
    """noack reads one of its triangles: the checker must not take another rule for that of the file."""
    content = dict(resolved_content(resolved(name)))
    trigger = copy.deepcopy(content["trigger"])
    n = len(content["model"]["A"])
    Q = trigger.setdefault("Q", np.eye(n).tolist())
    read_loop(content | {"trigger": trigger}, box=False, ideal=False)
    Q[0][1] += change
    with pytest.raises(RefusedError, match=r"^trigger\.Q: not symmetric"):
        read_loop(content | {"trigger": trigger}, box=False, ideal=False)


def test_the_lyapunov_function_of_a_trigger_is_stated_and_used_as_it_is() -> None:
    trigger = 'trigger={policy="dynamic", sigma=0.2, theta_s=0.5, decay_per_s=0.3}'
    own = first_loop("double_integrator", trigger)
    tables = tables_of(own)
    P = np.array(tables["trigger"]["P"])
    A, B, K = (np.array(tables["model"][key]) for key in ("A", "B", "gain"))
    F = A + B @ K
    np.testing.assert_allclose(F.T @ P + P @ F, -np.eye(len(A)), atol=1e-9)
    moved = (P * (1 + 2e-7)).tolist()
    rules = []
    for stated in (P.tolist(), moved):
        tables["trigger"]["P"] = stated
        rule = read_loop(tables, box=False, ideal=False).rule
        assert rule.memory is not None
        rules.append(floats(rule.memory.gain)[: len(A), len(A) :])
        np.testing.assert_array_equal(rules[-1], -np.array(stated) @ B)
    settings = own.trigger.model_copy(update={"P": tuple(map(tuple, moved))})
    of_process = resolve(own.model_copy(update={"trigger": settings}))
    assert of_process.trigger == settings
    with pytest.raises(CallerError, match=r"trigger\.P: AᵀP \+ PA is not −Q"):
        resolve(shipped("double_integrator", trigger, "trigger.P=[[1.0,0.0],[0.0,1.0]]"))
    del tables["trigger"]["P"]
    with pytest.raises(RefusedError, match=r"trigger\.P: missing"):
        read_loop(tables, box=False, ideal=False)

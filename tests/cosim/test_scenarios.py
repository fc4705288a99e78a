"""Every shipped scenario in virtual time, and the classic plants against their literature.

The published cases are in ``tests/published``, the cart-pole in
``tests/noack/plants/test_physical_laws.py``.
"""

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigvals, solve_continuous_are

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.claims.run_certificates import scheduled_certificates
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.summary_model import ClaimVerdict
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate, simulate_loops
from noack.core.linear_systems import Matrix
from noack.plants.four_tank import FourTankSettings
from noack.plants.plant_settings import OdeSystem
from noack.plants.quadrotor import QuadrotorSettings
from noack.plants.systems.linearisation import linearise
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import LoopMatrices, loop_of, resolve_run
from noack.theory.certificates.conditions import allowed_conditions
from tests.helpers.shipped import resolved, shipped

SCENARIOS = Path(__file__).parents[2] / "scenarios"
SHARED = (
    "different_loops", "priority_channel", "scheduled_channel", "shared_bottleneck",
    "shared_channel",
)  # fmt: skip
"""Several loops on one network."""
NAMES = sorted({path.stem for path in SCENARIOS.glob("*.toml")} - {*SHARED})
ENDS_BELOW = {"f16_lateral": 0.5, "pendulum_observed": 0.5, "lane_5g_rural": 0.5}
"""‖x(T)‖ / ‖x(0)‖. The F-16 starts with sideslip in rad and ends with a small rudder angle in °;
the pendulum is balanced from noisy angles; the rural network has an outage of ten seconds.
"""


@cache
def run_of(name: str) -> RunRecord:
    return simulate(resolved(name))


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_scenario_meets_its_assumptions_and_settles(name: str) -> None:
    record = run_of(name)
    summary = summarise_loop(record, 0, "horizon").to_json()
    assert summary["exit"]["status"] == 0
    assert summary["reached_s"] == pytest.approx(record.scenario.horizon_s)
    assert summary["missing_samples"] == 0
    assert summary["unintended_losses"] == 0
    assert summary["violations"] == []
    assert summary["watchdog"]["trips"] == 0
    assert summary["longest_loss_burst"] <= record.scenario.network.mansd
    shrunk = summary["final_state_norm"] / summary["initial_state_norm"]
    assert shrunk < ENDS_BELOW.get(name, 0.1)
    internal = record.scenario.plant.system.internal_names
    if internal:
        assert record[PLANT_STEP]["z"].shape[1] == len(internal)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "different_loops" else pytest.mark.deep) for name in SHARED],
)
def test_the_loops_of_a_shipped_network_settle_and_keep_what_is_claimed(name: str) -> None:
    shared = simulate_loops(resolve_run(shipped(name)))
    for record in shared.loops:
        summary = summarise_loop(record, 0, "horizon").to_json()
        assert summary["exit"]["status"] == 0
        assert summary["violations"] == []
        assert summary["longest_loss_burst"] <= record.scenario.network.mansd
        assert summary["final_state_norm"] < 0.1 * summary["initial_state_norm"]
    count = len(shared.names)
    for number in {0, count // 2, count - 1}:  # of every kind of loop
        verdicts = [claim.verdict for claim in RunClaims(shared.record(number)).evaluate()]
        assert ClaimVerdict.HELD in verdicts
        assert ClaimVerdict.VIOLATED not in verdicts


@pytest.mark.parametrize(
    ("name", "delay_s", "late"),
    [("urban", 0.144, []), ("arterial", 0.142, []), ("rural", 0.156, [(28.282, 4.512)])],
)
def test_the_certificates_on_recorded_networks_are_as_the_scenarios_say(
    name: str, delay_s: float, late: list[tuple[float, float]]
) -> None:
    """When an update is first too late for the certificates, and the longest delay, in seconds."""
    record = run_of(f"lane_5g_{name}")
    conditions = allowed_conditions(record.scenario)
    assert conditions.delay_s == pytest.approx(delay_s)
    excess = read_conditions(record).delay.excess(conditions.delay_s)
    assert [excess[:2] if excess else ()] == ([pytest.approx(each) for each in late] or [()])
    assert all(each.certificate.exists for each in scheduled_certificates(record.scenario))
    longest = resolved(f"lane_5g_{name}", "certificate={}")
    certified = [each.certificate.exists for each in scheduled_certificates(longest)]
    assert certified == [not late] * 2


def loop(name: str) -> LoopMatrices:
    return loop_of(resolved(name))


def closed(matrices: LoopMatrices) -> Matrix:
    poles: Matrix = np.linalg.eigvals(matrices.A_model + matrices.B_model @ matrices.K)
    return poles


# The quadruple-tank process: Johansson, IEEE Trans. Control Systems Technology 8(3), 2000.


def linear_tanks(**given: Any) -> tuple[Matrix, Matrix]:
    settings = FourTankSettings(kind="four_tank", **given)
    linear = linearise(lambda x0: OdeSystem(settings.equations(), x0), 4, 2)
    return linear.A, linear.B


def zeros(A: Matrix, B: Matrix) -> list[float]:
    """From levels 1 and 2, by the generalised eigenvalues of Rosenbrock's matrix."""
    C = np.eye(2, 4)
    pencil = np.block([[A, B], [C, np.zeros((2, 2))]])
    weight = np.diag([1.0, 1, 1, 1, 0, 0])
    eigenvalues = eigvals(pencil, weight)
    return sorted(eigenvalues[np.isfinite(eigenvalues)].real.tolist())


def test_the_tanks_time_constants_gains_and_zeros_are_johanssons() -> None:
    """For P₋: 62, 90, 23 and 30 s; gains 2.6, 1.5, 1.4 and 2.8; zeros −0.060 and −0.018 /s."""
    A, B = linear_tanks()
    np.testing.assert_allclose(loop("four_tank").A_model, A, atol=2e-6)
    np.testing.assert_allclose(loop("four_tank").B_model, B, atol=2e-6)
    np.testing.assert_allclose(-1 / np.diag(A), [62, 90, 23, 30], atol=0.7)
    gains = 0.5 * np.linalg.solve(-A, B)[:2]  # 0.5 V per cm
    np.testing.assert_allclose(gains, [[2.6, 1.5], [1.4, 2.8]], atol=0.05)
    np.testing.assert_allclose(zeros(A, B), [-0.060, -0.018], atol=6e-4)


# The F-16: Stevens and Lewis, Aircraft Control and Simulation, Example 5.3-1.


def test_the_f16s_modes_are_the_published_ones() -> None:
    """Dutch roll −0.42 ± 3.06j, roll −3.615, spiral −0.0163 /s, and servos of 20.2 /s."""
    poles = np.linalg.eigvals(loop("f16_lateral").A_model)
    expected = [-20.2, -20.2, -3.615, -1.0, -0.4224 - 3.0635j, -0.4224 + 3.0635j, -0.0163]
    ordered = sorted(poles, key=lambda pole: (pole.real, pole.imag))
    np.testing.assert_allclose(ordered, expected, atol=5e-4)


# The double integrator and its linear-quadratic regulator.


def test_the_double_integrators_regulator_is_the_textbooks() -> None:
    """Gain (1, √2), poles (−1 ± j)/√2; ∫ position² + u² = √2 from (1, 0)."""
    matrices = loop("double_integrator")
    P = solve_continuous_are(matrices.A_model, matrices.B_model, np.diag([1.0, 0.0]), np.eye(1))
    np.testing.assert_allclose(matrices.K, -matrices.B_model.T @ P, atol=1e-9)
    poles = sorted(closed(matrices), key=lambda pole: pole.imag)
    np.testing.assert_allclose(poles, np.array([-1 - 1j, -1 + 1j]) / math.sqrt(2), atol=1e-9)
    fine = simulate(resolved("double_integrator", "plant.draw=nominal", "trigger.beta=1e-6",
                            "trigger.floor=1e-6", "network.loss={model='lossless'}"))  # fmt: skip
    steps = fine[PLANT_STEP]
    cost = np.sum(steps["x"][:, 0] ** 2 + steps["u"][:, 0] ** 2) * 2e-3
    assert cost == pytest.approx(math.sqrt(2), rel=4e-3)  # sampled every 1/700 of its time constant


# A quadrotor: Luukkonen, Modelling and Control of Quadcopter, Aalto University, 2011.


def test_the_quadrotors_gain_is_the_regulator_named_in_its_scenario() -> None:
    """Its model is the linearisation of its plant."""
    matrices, settings = loop("quadrotor_hover"), QuadrotorSettings(kind="quadrotor")
    linear = linearise(lambda x0: OdeSystem(settings.equations(), x0), 12, 4)
    np.testing.assert_allclose(matrices.A_model, linear.A, atol=1e-6)
    np.testing.assert_allclose(matrices.B_model, linear.B, atol=1e-5)
    Q, R = np.diag([1.0] * 6 + [0.5] * 3 + [0.1] * 3), np.diag([1.0, 100.0, 100.0, 100.0])
    P = solve_continuous_are(matrices.A_model, matrices.B_model, Q, R)
    np.testing.assert_allclose(matrices.K, -np.linalg.solve(R, matrices.B_model.T @ P), atol=1e-5)


def test_luukkonens_gains_level_the_quadrotor_within_his_five_seconds() -> None:
    """From 1 m and 10° of each angle, by his PD gains (2.5, 1.5 for height; 1.75, 6 for angles)."""
    settings = QuadrotorSettings(kind="quadrotor")
    K = np.zeros((4, 12))
    K[0, [2, 8]] = np.array([-1.5, -2.5]) * settings.mass_kg
    for axis, inertia in enumerate(settings.inertia_kg_m2):
        K[1 + axis, [3 + axis, 9 + axis]] = np.array([-6.0, -1.75]) * inertia
    aslant = math.radians(10)
    system = OdeSystem(settings.equations(), np.array([0.0, 0, 1, aslant, aslant, aslant, 0, 0, 0, 0, 0, 0]))
    h_ns = 2_000_000
    for step in range(2500):
        system.advance(K @ system.x, step * h_ns, h_ns)
    assert np.abs(system.x[3:6]).max() < 0.02 * aslant  # the usual 2 %
    assert abs(system.x[2]) < 0.07  # of 1 m: its slower pole, −0.62 /s with drag, leaves 6 %
    # the horizontal position is not controlled, as he remarks
    assert np.abs(system.x[:2]).max() > 0.3


def test_a_quadrotor_in_free_fall_without_drag_keeps_its_energy_and_its_angular_momentum() -> None:
    settings = QuadrotorSettings(kind="quadrotor", drag_kg_per_s=(0.0, 0.0, 0.0))
    inertia = np.array(settings.inertia_kg_m2)
    start = np.array([0, 0, 0, 0.3, -0.2, 0.1, 1.0, -2.0, 3.0, 1.0, 1.5, -0.7])
    system = OdeSystem(settings.equations(), start)
    weight = settings.mass_kg * settings.gravity_m_per_s2

    def energy(x: Matrix) -> float:
        moving = settings.mass_kg * float(x[6:9] @ x[6:9]) + float(inertia @ x[9:] ** 2)
        return 0.5 * moving + weight * float(x[2])

    def spin(x: Matrix) -> Matrix:
        (sr, sp, sy), (cr, cp, cy) = np.sin(x[3:6]), np.cos(x[3:6])
        about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        turned: Matrix = about_z @ about_y @ about_x @ (inertia * x[9:])
        return turned

    for step in range(250):
        system.advance(np.array([-weight, 0, 0, 0]), step * 2_000_000, 2_000_000)
    assert energy(system.x) == pytest.approx(energy(start), rel=1e-8)
    np.testing.assert_allclose(spin(system.x), spin(start), rtol=1e-7)
    assert np.abs(system.x[3:6] - start[3:6]).max() > 0.3

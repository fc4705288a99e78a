"""Plants by their physical laws, published numbers and other solvers; properties of every kind."""

import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp

from noack.plants.cart_pole import CartPoleSettings
from noack.plants.dc_motor import DcMotor, DcMotorSettings
from noack.plants.plant_settings import OdeSystem, PlantEquations, PlantSettings
from noack.plants.systems.linearisation import linearise
from noack.scenario.scenario import Scenario
from noack.scenario.sections import PLANTS
from plant_server.plant import system_of
from tests.helpers.shipped import resolved
from tests.noack.plants.motion import H_NS, motion

INDUCTANCES = (2.75e-6, 1e-3, 0.5)
"""The last one makes speed and current oscillate."""


def settings(**given: Any) -> DcMotorSettings:
    return DcMotorSettings(kind="dc_motor", **given)


def published() -> signal.TransferFunction:
    """θ(s)/V(s) = K/(s((Js + b)(Ls + R) + K²)), University of Michigan, "DC Motor Position"."""
    J, b, K, R, L = 3.2284e-6, 3.5077e-6, 0.0274, 4.0, 2.75e-6
    return signal.TransferFunction([K], np.polymul([1, 0], np.polyadd(np.polymul([J, b], [L, R]), [K**2])))


def test_the_step_response_is_the_published_transfer_functions() -> None:
    _, angle = signal.step(published(), T=np.arange(101) * H_NS * 1e-9)
    states = motion(DcMotor(settings(), np.zeros(3)), [1.0] * 100)
    np.testing.assert_allclose(states[:, 0], angle, atol=1e-9)
    assert angle[-1] > 5.0


def reference(motor: DcMotorSettings, x: np.ndarray, voltage: float, end_s: float) -> np.ndarray:
    """The same law by an implicit integrator with events: forward, backward, at standstill."""
    J, b, L = motor.inertia_kg_m2, motor.friction_n_m_s, motor.inductance_h
    K, R, T_c = motor.torque_constant_n_m_per_a, motor.resistance_ohm, motor.coulomb_friction_n_m
    t_s, x = 0.0, x.copy()
    while t_s < end_s:
        turning = math.copysign(1, x[1]) if x[1] else 0.0
        steady = voltage / R
        if not x[1] and K * abs(x[2]) > T_c * (1 - 1e-9) and K * steady * np.sign(x[2]) > T_c:
            turning = math.copysign(1, x[2])

        def derivative(_: float, z: np.ndarray, s: float = turning) -> list[float]:
            acceleration = (K * z[2] - b * z[1] - s * T_c) / J if s else 0.0
            return [z[1], acceleration, (voltage - R * z[2] - K * z[1]) / L]

        def change(_: float, z: np.ndarray, s: float = turning) -> float:
            return float(s * z[1] if s else abs(K * z[2]) - T_c)

        change.terminal, change.direction = True, -1 if turning else 1  # type: ignore[attr-defined]
        solution = solve_ivp(
            derivative, (t_s, end_s), x, events=change, method="Radau", rtol=1e-9, atol=1e-12
        )
        t_s, x = solution.t[-1], solution.y[:, -1].copy()
        if solution.status == 1 and turning:
            x[1] = 0.0
    return x


@pytest.mark.parametrize("inductance_h", INDUCTANCES)
def test_friction_and_stiction_agree_with_another_solver(inductance_h: float) -> None:
    motor = settings(inductance_h=inductance_h, coulomb_friction_n_m=1e-3)
    system, expected = DcMotor(motor, np.array([0.0, 5.0, 0.0])), np.array([0.0, 5.0, 0.0])
    stuck = 0
    for voltage in np.random.default_rng(0).choice([0.0, 0.1, -0.1, 0.5, -0.6, 2.0], 12):
        system.advance(np.array([voltage]), 0, 5_000_000)
        expected = reference(motor, expected, voltage, 5e-3)
        np.testing.assert_allclose(system.x, expected, rtol=1e-7, atol=1e-8)
        stuck += system.x[1] == 0.0
    # With a large inductance, the current changes too slowly for a stop of a whole step.
    assert stuck or inductance_h > 1e-3


def energy(settings: CartPoleSettings, x: np.ndarray) -> float:
    _, v, angle, rate = x.tolist()
    m, length = settings.pole_kg, settings.length_m
    along, up = v + length * rate * math.cos(angle), -length * rate * math.sin(angle)
    kinetic = settings.cart_kg * v**2 + m * (along**2 + up**2) + settings.inertia_kg_m2 * rate**2
    return 0.5 * kinetic + m * settings.gravity_m_per_s2 * length * math.cos(angle)


def test_a_free_cart_pole_keeps_its_energy_and_its_momentum() -> None:
    settings = CartPoleSettings(kind="cart_pole", friction_n_s_per_m=0.0)
    states = motion(OdeSystem(settings.equations(), np.array([0.3, -0.2, 1.0, 0.5])), [0.0] * 500)
    assert np.ptp(states[:, 2]) > 1.0  # it has fallen
    energies = [energy(settings, x) for x in states]
    np.testing.assert_allclose(energies, energies[0], rtol=1e-7)
    total, moment = settings.cart_kg + settings.pole_kg, settings.pole_kg * settings.length_m
    momentum = total * states[:, 1] + moment * states[:, 3] * np.cos(states[:, 2])
    np.testing.assert_allclose(momentum, momentum[0], atol=1e-8)


def test_its_linearisation_has_the_poles_of_the_literature() -> None:
    """Open-loop poles by the Control Tutorials (MATLAB): 0, -0.1428, -5.6041, 5.5651."""
    equations = CartPoleSettings(kind="cart_pole").equations()
    linear = linearise(lambda x0: OdeSystem(equations, x0), 4, 1)
    poles = np.sort(np.linalg.eigvals(linear.A).real)
    np.testing.assert_allclose(poles, [-5.6041, -0.1428, 0.0, 5.5651], atol=1e-4)
    np.testing.assert_allclose(linear.B[:, 0], [0.0, 1.8182, 0.0, -4.5455], atol=1e-4)


def test_arithmetic_errors_in_a_derivative_count_as_divergence_others_are_raised() -> None:
    def broken(t: float, z: np.ndarray, v: np.ndarray) -> tuple[float]:
        if t > 0.003:
            raise [OverflowError, KeyError][int(v[0])]("far")
        return (1.0,)

    states = motion(OdeSystem(PlantEquations(broken), np.zeros(1)), [0.0, 0.0])
    assert states[1] == pytest.approx([0.002])
    assert np.isnan(states[2]).all()
    with pytest.raises(KeyError, match="far"):
        motion(OdeSystem(PlantEquations(broken), np.zeros(1)), [1.0, 1.0])


def test_a_non_finite_state_stays_non_finite() -> None:
    assert np.isnan(motion(DcMotor(settings(), np.zeros(3)), [np.nan, 0.0])[1:]).all()


def test_the_linearisation_has_the_published_frequency_response() -> None:
    A, B = settings().linearisation()
    w = np.logspace(-1, 7, 50)
    _, expected = signal.freqresp(published(), w)
    response = [(np.linalg.solve(1j * frequency * np.eye(3) - A, B))[0, 0] for frequency in w]
    np.testing.assert_allclose(response, expected, rtol=1e-9)


# --- every kind of plant --------------------------------------------------------------------------

ROOT = Path(__file__).parents[3]
STEPS = 25


CASES = sorted({settings.scenario for settings in PLANTS.values() if settings.scenario})


def moved(scenario: Scenario, inputs: np.ndarray) -> np.ndarray:
    return motion(system_of(scenario), inputs, scenario.timing.plant_period_ns)


@pytest.mark.parametrize("name", CASES)
def test_the_operating_point_is_an_equilibrium(name: str) -> None:
    n, m = resolved(name).model.dimensions
    at_rest = resolved(name, f"plant.initial_state={[0.0] * n}")
    states = moved(at_rest, np.zeros((STEPS, m)))
    np.testing.assert_allclose(states, 0.0, atol=1e-3)


@pytest.mark.parametrize("name", CASES)
def test_the_same_inputs_give_bit_identical_states(name: str) -> None:
    scenario = resolved(name)
    inputs = 0.01 * np.random.default_rng(1).normal(size=(STEPS, scenario.model.dimensions[1]))
    first = moved(scenario, inputs)
    moved(scenario, -inputs)
    assert np.isfinite(first).all()
    assert moved(scenario, inputs).tobytes() == first.tobytes()


def row(kind: str, settings: type[PlantSettings]) -> str:
    summary = (settings.__doc__ or "").partition("\n")[0].removesuffix(".")
    states, inputs = ("; ".join(names) or "any" for names in (settings.states, settings.inputs))
    scenario = f"`{settings.scenario}`" if settings.scenario else ""
    return f"| `{kind}` | {summary} | {states} | {inputs} | {scenario} |"


def test_the_documented_keys_are_those_of_the_settings() -> None:
    """docs/scenarios.md has a row per kind, with every key and some defaults."""
    text = (ROOT / "docs/scenarios.md").read_text()
    section = text[text.index("\n## Plants\n") : text.index("\n## Trigger policies\n")]
    for kind, settings in PLANTS.items():
        row = next(line for line in section.splitlines() if line.startswith(f"| `{kind}` |"))
        keys = dict(re.findall(r"`(\w+)(?: = ([^`]+))?`", row.split("|")[-2]))
        fields = {key: field for key, field in settings.model_fields.items() if key != "kind"}
        assert keys.keys() == fields.keys(), kind
        for key, default in keys.items():
            if default:
                assert tomllib.loads(f"value = {default}")["value"] == list_of(fields[key].default)


def list_of(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def test_the_documented_kinds_are_those_of_the_registry() -> None:
    text = (ROOT / "docs/plants.md").read_text()
    for kind, settings in PLANTS.items():
        assert row(kind, settings) in text

"""Nonlinear systems: their physical laws, and bit-exact repetition."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from noack.plants.cart_pole import CartPoleSettings
from noack.plants.plant_settings import OdeSystem, PlantEquations
from noack.plants.systems.plant_linearisation import linearise
from tests.noack.plants.motion import motion


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


def test_energy_changes_by_the_work_of_force_and_friction() -> None:
    settings = CartPoleSettings(kind="cart_pole")
    force, h_ns = 0.7, 500_000
    states = motion(
        OdeSystem(settings.equations(), np.array([0.0, 0.1, 0.2, 0.0])), [force] * 2000, h_ns
    )
    power = force * states[:, 1] - settings.friction_n_s_per_m * states[:, 1] ** 2
    work = np.trapezoid(power, dx=h_ns * 1e-9)
    gained = energy(settings, states[-1]) - energy(settings, states[0])
    assert gained == pytest.approx(work, rel=1e-5)


def test_its_linearisation_has_the_poles_of_the_literature() -> None:
    """Open-loop poles by the Control Tutorials (MATLAB): 0, -0.1428, -5.6041, 5.5651."""
    A, B = linearise(lambda x0: OdeSystem(CartPoleSettings(kind="cart_pole").equations(), x0), 4, 1)
    poles = np.sort(np.linalg.eigvals(A).real)
    np.testing.assert_allclose(poles, [-5.6041, -0.1428, 0.0, 5.5651], atol=1e-4)
    np.testing.assert_allclose(B[:, 0], [0.0, 1.8182, 0.0, -4.5455], atol=1e-4)


def test_the_integration_agrees_with_another_solver() -> None:
    def pendulum(t: float, z: np.ndarray, v: np.ndarray) -> tuple[float, float]:
        return float(z[1]), -math.sin(float(z[0])) + float(v[0]) * math.cos(3 * t)

    system = OdeSystem(PlantEquations(pendulum), np.array([2.0, 0.0]))
    states = motion(system, [0.5] * 500, 20_000_000)
    exact = solve_ivp(
        lambda t, z: pendulum(t, z, np.array([0.5])), (0, 10), [2.0, 0.0],
        method="DOP853", rtol=1e-13, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(states[-1], exact.y[:, -1], atol=1e-6)


def test_the_state_is_nan_after_it_has_escaped() -> None:
    """ż = z² from 1 is infinite at 1 s."""

    def escaping(t: float, z: np.ndarray, v: np.ndarray) -> tuple[float]:
        return (float(z[0]) ** 2,)

    system = OdeSystem(PlantEquations(escaping), np.array([1.0]))
    states = motion(system, [0.0] * 20, 100_000_000)
    assert np.isfinite(states[9]).all()
    assert np.isnan(states[12:]).all()


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

"""Linear models of plants: against closed forms, and where there is none."""

import itertools
import math
from typing import Any

import numpy as np
import pytest

from noack.plants.plant_settings import OdeSystem, PlantEquations
from noack.plants.systems.linearisation import (
    NO_LOGARITHM,
    NOT_FINITE,
    NOT_REPEATED,
    largest_errors,
    linearise,
)


def pendulum(_: float, z: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    return z[1], 9.81 * math.sin(z[0]) - 0.1 * z[1] + v[0] * math.cos(z[0])


def system(x0: np.ndarray) -> OdeSystem:
    return OdeSystem(PlantEquations(pendulum), x0)


class Moved:
    """A system that only moves: x(t + h) = step(x(t), u)."""

    z = np.zeros(0)

    def __init__(self, step: Any, x0: np.ndarray) -> None:
        self._step, self.x = step, x0

    def advance(self, u: np.ndarray, t_ns: int, dt_ns: int) -> None:
        self.x = self._step(self.x, u)


@pytest.mark.parametrize("angle", [0.0, 1.0, math.pi])
def test_a_pendulum_has_its_jacobian_at_any_point(angle: float) -> None:
    linear = linearise(system, 2, 1, x0=np.array([angle, 0.2]), u0=np.array([0.3]))
    sine, cosine = math.sin(angle), math.cos(angle)
    np.testing.assert_allclose(linear.A, [[0, 1], [9.81 * cosine - 0.3 * sine, -0.1]], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(linear.B, [[0], [cosine]], rtol=1e-9)
    np.testing.assert_allclose(linear.drift, [0.2, 9.81 * sine - 0.02 + 0.3 * cosine], rtol=1e-12)
    assert linear.source == "derivative"
    assert linear.void is None


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_units_of_any_size_do_not_change_the_relative_accuracy(scale: float) -> None:
    def scaled(t: float, z: np.ndarray, v: np.ndarray) -> tuple[float, float]:
        rate, acceleration = pendulum(t, z, v * scale)
        return rate, acceleration

    at = np.zeros(2)
    linear = linearise(lambda x0: OdeSystem(PlantEquations(scaled), x0), 2, 1, x0=at)
    np.testing.assert_allclose(linear.B, [[0.0], [scale]], rtol=1e-9)
    np.testing.assert_allclose(linear.A, [[0.0, 1.0], [9.81, -0.1]], rtol=1e-9)


def test_the_motion_and_the_derivative_give_the_same_model() -> None:
    class OnlyMoved(OdeSystem):
        rates = None  # type: ignore[assignment]

    linear = linearise(lambda x0: OnlyMoved(PlantEquations(pendulum), x0), 2, 1)
    assert linear.source == "motion"
    np.testing.assert_allclose(linear.A, [[0, 1], [9.81, -0.1]], atol=1e-6)
    np.testing.assert_allclose(linear.B, [[0], [1]], atol=1e-6)


def test_the_remainder_is_of_the_second_order() -> None:
    """At θ₀ = 1 it is −g sin θ₀ δ²/2 and smaller terms, relative to the largest linear part."""
    at, held = np.array([1.0, 0.0]), np.zeros(1)
    linear = linearise(system, 2, 1, x0=at)
    sizes = [
        largest_errors(system, linear, np.array([width, width, 0.0]), x0=at, u0=held) for width in (0.1, 0.01)
    ]
    expected = 9.81 * math.sin(1.0) * 0.01**2 / 2 / (0.01 * (9.81 * math.cos(1.0) + 0.1))
    assert sizes[1][0] == 0.0  # ẋ₁ = x₂ is linear
    assert sizes[1][1] == pytest.approx(expected, rel=0.02)
    assert sizes[0][1] == pytest.approx(10 * expected, rel=0.1)


DRAWN = itertools.count()  # as a plant that draws random numbers


def test_a_derivative_that_is_not_the_same_twice_has_no_model() -> None:
    equations = PlantEquations(lambda t, z, u: (u[0] - z[0] + next(DRAWN),))
    linear = linearise(lambda x0: OdeSystem(equations, x0), 1, 1)
    assert linear.void == NOT_REPEATED


@pytest.mark.parametrize(("step", "why"), [
    (lambda x, u: -0.5 * x + u, NO_LOGARITHM),
    (lambda x, u: 0.0 * x + u, NO_LOGARITHM),
    (lambda x, u: x + np.where(u > 0, np.nan, u), NOT_FINITE),
    (lambda x, u: 0.5 * x + u + next(DRAWN), NOT_REPEATED),
])  # fmt: skip
def test_a_step_without_a_model_in_continuous_time_says_why(step: Any, why: str) -> None:
    linear = linearise(lambda x0: Moved(step, x0), 1, 1)
    assert linear.void == why
    assert np.isnan(linear.A).all()


def test_dry_friction_is_found_by_the_error() -> None:
    def dry(_: float, z: np.ndarray, v: np.ndarray) -> tuple[float]:
        return (v[0] - math.copysign(0.05, z[0]),)

    def at(x0: np.ndarray) -> OdeSystem:
        return OdeSystem(PlantEquations(dry), x0)

    x, u = np.array([0.2]), np.zeros(1)
    linear = linearise(at, 1, 1, x0=x)
    assert largest_errors(at, linear, np.full(2, 0.1), x0=x, u0=u)[0] == 0.0
    assert largest_errors(at, linear, np.full(2, 0.5), x0=x, u0=u)[0] > 0.1


def test_a_step_is_left_out_if_it_is_steep_for_the_usual_deviations() -> None:
    def shaft(_: float, z: np.ndarray, v: np.ndarray) -> tuple[float, float]:
        return z[1], v[0] - 2.0 * z[1] - 3.0 * np.tanh(z[1] / 0.1) + np.sin(z[0])

    def model(*sizes: float) -> np.ndarray:
        system = OdeSystem(PlantEquations(shaft), np.zeros(2))
        linear = linearise(lambda x0: system, 2, 1, beside=np.array(sizes))
        return np.hstack([linear.A, linear.B])

    assert np.allclose(model(1.0, 5.0, 5.0), [[0, 1, 0], [1, -2, 1]], atol=1e-6)  # sin has no step
    assert np.allclose(model(1.0, 0.01, 5.0), [[0, 1, 0], [1, -32, 1]], atol=1e-6)


def test_a_jump_at_the_point_is_left_out() -> None:
    """A shaft at standstill with dry and viscous friction has the slope of the viscous friction."""

    def shaft(_: float, z: np.ndarray, v: np.ndarray) -> tuple[float, float]:
        return z[1], v[0] - 2.0 * z[1] - 3.0 * np.sign(z[1]) + math.sin(z[0])

    linear = linearise(lambda x0: OdeSystem(PlantEquations(shaft), x0), 2, 1)
    assert np.allclose(np.hstack([linear.A, linear.B]), [[0, 1, 0], [1, -2, 1]], atol=1e-9)

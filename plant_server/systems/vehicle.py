"""A road vehicle: the vehicle models of CommonRoad, steered by a servo, along a lane.

The library's equations and parameters are used as they are. The lane is its x-axis. The lane models
(:mod:`noack.config.named_models`) have the lateral axis point the other way, so that V and Y_g have
the opposite sign of its lateral velocity and y; yaw, yaw rate and steering angle have the same.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from noack.config.plant_systems import VehicleSettings
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from plant_server.ode_integrator import OdeSystem
from plant_server.systems.equations import equations, library

_PARAMETERS = {"ford_escort": 1, "bmw_320i": 2, "vw_vanagon": 3, "truck": 4}


class _Model(NamedTuple):
    """One of the library's models, and what it is to the loop."""

    start: Callable[[Vector, float, Any], list[float]]
    """z(0) from x(0), the speed and the parameters."""
    output: Callable[[Any], Callable[[Vector], Vector]]
    """x as a function of z, given the parameters."""
    relative: float = 1e-9
    """Relative tolerance of the integration."""


def vehicle(settings: VehicleSettings, x0: Vector) -> OdeSystem:
    """Return the system, its steering straight; its own state is that of the library's model.

    The servo turns the wheels by (u − δ)/T within the limits of angle and rate, and the vehicle
    accelerates by k (speed asked for − speed), within its limits.

    Args:
        settings: which model and parameters, speed, servo.
        x0: x(0): V, r, ψ, Y_g, shape (4,).

    Raises:
        CallerError: the library is not installed, or the vehicle is not so fast.
    """
    settings.require_installed()
    model = _MODELS[settings.library_model]
    parameters = _parameters_of(settings)
    speed, servo_s, hold = settings.speed_m_per_s, settings.steering_s, settings.speed_gain_per_s
    if speed > (fastest := parameters.longitudinal.v_max):
        raise CallerError(
            f"plant.system.speed_m_per_s: a {settings.parameters} goes {fastest:g} m/s at most; "
            f"it cannot keep {speed:g}"
        )
    z0 = np.array(model.start(x0, speed, parameters), dtype=np.float64)
    rates = equations(settings.library_model, parameters)
    leftmost, rightmost = parameters.steering.min, parameters.steering.max

    def derivative(t_s: float, z: Vector, v: Vector) -> Vector:
        asked = min(max(float(v[0]), leftmost), rightmost)
        return rates(z, (asked - float(z[2])) / servo_s, hold * (speed - float(z[3])))

    return OdeSystem(
        derivative,
        z0,
        output=model.output(parameters),
        relative=model.relative,
        absolute=1e-3 * model.relative,
    )


@cache
def _parameters_of(settings: VehicleSettings) -> Any:
    number = _PARAMETERS[settings.parameters]
    parameters = library(f"parameters_vehicle{number}")()
    parameters.tire.p_dx1 *= settings.friction
    parameters.tire.p_dy1 *= settings.friction
    return parameters


def _start(x0: Vector, speed: float, parameters: Any) -> list[float]:
    sideways, rate, yaw, lateral = x0.tolist()
    slip = math.atan2(-sideways, speed)
    return [0.0, -lateral, 0.0, math.hypot(sideways, speed), yaw, rate, slip]


def _see(parameters: Any) -> Callable[[Vector], Vector]:
    def see(z: Vector) -> Vector:
        return np.array([-z[3] * math.sin(z[6]), z[5], z[4], -z[1]])

    return see


def _start_kinematic(x0: Vector, speed: float, parameters: Any) -> list[float]:
    # Its reference is the rear axle; V follows from r, and r is steered.
    _, rate, yaw, lateral = x0.tolist()
    steering = math.atan(rate * (parameters.a + parameters.b) / speed)
    return [0.0, -lateral - parameters.b * math.sin(yaw), steering, speed, yaw]


def _see_kinematic(parameters: Any) -> Callable[[Vector], Vector]:
    behind, wheelbase = parameters.b, parameters.a + parameters.b

    def see(z: Vector) -> Vector:
        rate = z[3] * math.tan(z[2]) / wheelbase
        return np.array([-behind * rate, rate, z[4], -z[1] - behind * math.sin(z[4])])

    return see


def _start_drift(x0: Vector, speed: float, parameters: Any) -> list[float]:
    started: list[float] = library("init_std")(_start(x0, speed, parameters), parameters)
    return started


def _start_multi_body(x0: Vector, speed: float, parameters: Any) -> list[float]:
    started: list[float] = library("init_mb")(_start(x0, speed, parameters), parameters)
    return started


def _see_multi_body(parameters: Any) -> Callable[[Vector], Vector]:
    def see(z: Vector) -> Vector:
        return np.array([-z[10], z[5], z[4], -z[1]])

    return see


_MODELS = {
    "ks": _Model(_start_kinematic, _see_kinematic),
    "kst": _Model(lambda *given: [*_start_kinematic(*given), 0.0], _see_kinematic),
    "st": _Model(_start, _see),
    "std": _Model(_start_drift, _see, relative=1e-7),
    "mb": _Model(_start_multi_body, _see_multi_body, relative=1e-6),
}

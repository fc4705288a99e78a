"""A road vehicle: the vehicle models of CommonRoad, steered by a servo, along a lane.

The library's equations and parameters are used unchanged. The lane is the library's x-axis. The
lateral axis of the lane models (:mod:`noack.plants.linear`) has the opposite direction: V
and Y_g are minus the library's lateral velocity and y. Yaw, yaw rate and steering angle have the
same sign.
"""

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import EquationSettings, PlantEquations
from noack.plants.systems import vehicle_compilation
from noack.plants.systems.vehicle_compilation import Parameters, library
from noack.settings.section import Positive

_CORE = ("x_position", "y_position", "steering_angle", "speed", "yaw")
_SINGLE_TRACK = (*_CORE, "yaw_rate", "slip_angle")
_MULTI_BODY = (
    *_CORE, "yaw_rate",
    "roll", "roll_rate", "pitch", "pitch_rate", "lateral_velocity", "height", "climb_rate",
    "front_roll", "front_roll_rate", "front_lateral_velocity", "front_height", "front_climb_rate",
    "rear_roll", "rear_roll_rate", "rear_lateral_velocity", "rear_height", "rear_climb_rate",
    "left_front_wheel_rate", "right_front_wheel_rate",
    "left_rear_wheel_rate", "right_rear_wheel_rate",
    "front_axle_shift", "rear_axle_shift",
)  # fmt: skip
_PARAMETERS = {"ford_escort": 1, "bmw_320i": 2, "vw_vanagon": 3, "truck": 4}


class VehicleSettings(EquationSettings):
    """A road vehicle of CommonRoad's vehicle models; the lane is the x-axis.

    Althoff and Würsching, "CommonRoad: Vehicle Models", 2020. x is the state of the lane models: V
    and Y_g have the opposite sign of the library's coordinates. u is the requested steering angle.
    """

    states: ClassVar = (
        "lateral velocity V, m/s",
        "yaw rate r, rad/s",
        "yaw psi, rad",
        "lateral position Y_g, m",
    )
    inputs: ClassVar = ("steering angle, rad",)
    needs: ClassVar = ("vehiclemodels", "vehicle")
    scenario: ClassVar = "lane_vehicle"
    variants: ClassVar = (
        {"model": "kinematic"},
        {"model": "single_track"},
        {"model": "drift"},
        {"model": "multi_body"},
    )

    kind: Literal["vehicle"]
    model: Literal["kinematic", "single_track", "drift", "multi_body"] = "single_track"
    """The library's model: ks (kst for the truck), st, std or mb, in order of their number of
    states."""
    parameters: Literal["ford_escort", "bmw_320i", "vw_vanagon", "truck"] = "bmw_320i"
    """The library's parameter set, 1 to 4; the truck has a kinematic model only."""
    speed_m_per_s: Positive = 15.0
    """The initial speed, which the vehicle keeps."""
    speed_gain_per_s: Annotated[FiniteFloat, Field(ge=0, le=100)] = 1.0
    """Acceleration per deviation from the initial speed."""
    steering_s: Annotated[FiniteFloat, Field(ge=0.001, le=10)] = 0.05
    """Time constant of the steering servo; the vehicle limits its angle and its rate."""
    friction: Annotated[FiniteFloat, Field(gt=0, le=2)] = 1.0
    """Friction of the road, as a multiple of the tyres' own; for "drift" and "multi_body"."""

    @property
    def settling_s(self) -> float:
        return 8 * self.steering_s

    @property
    def library_model(self) -> str:
        """The library's name of the model."""
        kinematic = "kst" if self.parameters == "truck" else "ks"
        names = {"kinematic": kinematic, "single_track": "st", "drift": "std", "multi_body": "mb"}
        return names[self.model]

    @property
    def internal_names(self) -> tuple[str, ...]:
        """The states of the library's model, SI units."""
        kinematic = (*_CORE, "hitch_angle") if self.parameters == "truck" else _CORE
        return {
            "kinematic": kinematic,
            "single_track": _SINGLE_TRACK,
            "drift": (*_SINGLE_TRACK, "front_wheel_rate", "rear_wheel_rate"),
            "multi_body": _MULTI_BODY,
        }[self.model]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.parameters == "truck" and self.model != "kinematic":
            raise ValueError(
                f'parameters: the library has no masses for its "truck", which "{self.model}" '
                'needs; take model = "kinematic" or another vehicle'
            )
        if self.friction != 1 and self.model in ("kinematic", "single_track"):
            raise ValueError(f'friction: the model "{self.model}" has none; take "drift" or "multi_body"')
        return self

    def prepare(self) -> None:
        self.require_installed()
        if not vehicle_compilation.is_compiled(self.library_model):
            vehicle_compilation.compiled_dynamics(self.library_model)

    def equations(self) -> PlantEquations:
        """Return the equations; z is the state of the library's model, initially not steered.

        The servo turns the wheels by (u − δ)/T within the limits of angle and rate. The vehicle
        accelerates by k (requested speed − speed), within its limits.

        Raises:
            CallerError: the library is not installed, or the vehicle cannot reach the speed.
        """
        self.require_installed()
        model, parameters = _MODELS[self.library_model], _load_parameters(self)
        speed, servo_s, gain = self.speed_m_per_s, self.steering_s, self.speed_gain_per_s
        if speed > (fastest := parameters.longitudinal.v_max):
            raise CallerError(
                f"plant.system.speed_m_per_s: the maximum speed of a {self.parameters} is "
                f"{fastest:g} m/s; it cannot keep {speed:g}"
            )
        rates = vehicle_compilation.model_rates(self.library_model, parameters)
        compiled = vehicle_compilation.compiled_vehicle(self.library_model, parameters)
        lowest, highest = parameters.steering.min, parameters.steering.max
        tolerances = model.relative, 1e-3 * model.relative

        def physical(u: Vector) -> Vector:
            requested = min(max(float(u[0]), lowest), highest)
            return np.array([requested / servo_s, -1.0 / servo_s, gain * speed, -gain])

        def derivative(t_s: float, z: Vector, v: Vector) -> Vector:
            v0, v1, v2, v3 = v.tolist()
            return rates(z, v0 + v1 * float(z[2]), v2 + v3 * float(z[3]))

        def advance(z: Vector, v: Vector, t_s: float, duration_s: float) -> tuple[int, float]:
            assert compiled is not None
            return compiled.advance_in_place(z, v, duration_s, tolerances), t_s

        return PlantEquations(
            derivative,
            physical=physical,
            advance=advance if compiled else None,
            initial=lambda x0: np.array(model.start(x0, speed, parameters), dtype=np.float64),
            output=lambda z: model.output(z, parameters),
            relative=tolerances[0],
            absolute=tolerances[1],
            is_recorded=True,
        )


class _Model(NamedTuple):
    """One of the library's models."""

    start: Callable[[Vector, float, Parameters], list[float]]
    """z(0) from x(0), the speed and the parameters."""
    output: Callable[[Vector, Parameters], Vector]
    """x from z and the parameters."""
    relative: float = 1e-9
    """Relative tolerance of the integration."""


@cache
def _load_parameters(settings: VehicleSettings) -> Parameters:
    number = _PARAMETERS[settings.parameters]
    parameters = library(f"parameters_vehicle{number}")()
    parameters.tire.p_dx1 *= settings.friction
    parameters.tire.p_dy1 *= settings.friction
    return parameters


def _start(x0: Vector, speed: float, parameters: Parameters) -> list[float]:
    lateral_velocity, yaw_rate, yaw, lateral_position = x0.tolist()
    slip = math.atan2(-lateral_velocity, speed)
    return [0.0, -lateral_position, 0.0, math.hypot(lateral_velocity, speed), yaw, yaw_rate, slip]


def _output(z: Vector, parameters: Parameters) -> Vector:
    return np.array([-z[3] * math.sin(z[6]), z[5], z[4], -z[1]])


def _start_kinematic(x0: Vector, speed: float, parameters: Parameters) -> list[float]:
    # The reference point of this model is the rear axle; V follows from r, and the steering sets r.
    _, yaw_rate, yaw, lateral_position = x0.tolist()
    steering = math.atan(yaw_rate * (parameters.a + parameters.b) / speed)
    return [0.0, -lateral_position - parameters.b * math.sin(yaw), steering, speed, yaw]


def _output_kinematic(z: Vector, parameters: Parameters) -> Vector:
    to_rear_axle, wheelbase = parameters.b, parameters.a + parameters.b
    yaw_rate = z[3] * math.tan(z[2]) / wheelbase
    return np.array([-to_rear_axle * yaw_rate, yaw_rate, z[4], -z[1] - to_rear_axle * math.sin(z[4])])


def _start_by_library(name: str, x0: Vector, speed: float, parameters: Parameters) -> list[float]:
    state: list[float] = library(name)(_start(x0, speed, parameters), parameters)
    return state


_MODELS = {
    "ks": _Model(_start_kinematic, _output_kinematic),
    "kst": _Model(lambda *args: [*_start_kinematic(*args), 0.0], _output_kinematic),
    "st": _Model(_start, _output),
    "std": _Model(partial(_start_by_library, "init_std"), _output, relative=1e-7),
    "mb": _Model(
        partial(_start_by_library, "init_mb"),
        lambda z, _: np.array([-z[10], z[5], z[4], -z[1]]),
        relative=1e-6,
    ),
}

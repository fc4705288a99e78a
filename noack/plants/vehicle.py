"""A road vehicle: the vehicle models of CommonRoad, steered by a servo, along a lane.

The library's equations and parameters are used unchanged. The lane is the library's x-axis. The
lateral axis of the lane models (:mod:`noack.plants.linear`) has the opposite direction: V
and Y_g are minus the library's lateral velocity and y. Yaw, yaw rate and steering angle have the
same sign.

Equations with tyre models are compiled, and integrated by compiled code, which also locates their
jumps: a tyre's lateral force jumps where the wheel's camber changes its sign. The small models run
as Python code, with scipy's integrator. For them a call of compiled code costs more time than it
saves, because it needs more of the processor's caches, which other code overwrites between two
steps.
"""

import inspect
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, model_validator

from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import EquationSettings, PlantEquations
from noack.plants.systems import jump_integrator
from noack.plants.systems.code_cache import CALLED_BY_CODE, cache_folder, compiler, is_kept, while_compiling
from noack.plants.systems.jump_integrator import StepBuffers, advance, buffers
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
_LIBRARY = "vehiclemodels"
_COMPILED = ("std", "mb")
_WHEELS = 4
_OPTIONS: Any = {**CALLED_BY_CODE, "error_model": "python"}
_TYRE_FIELDS = [
    ("wheel", np.int64, 0),
    ("signs", (np.float64, _WHEELS), np.zeros(_WHEELS)),
    ("cambers", (np.float64, _WHEELS), np.zeros(_WHEELS)),
]
"""Fields, and their values, that a compiled vehicle has besides the library's tyre parameters."""
Compiled = Any  # a function, by numba
Parameters = Any
"""A parameter set of the library, or an array of one record of it."""
Rates = Callable[[Vector, float, float], Vector]
"""ż as a function of z (N,), steering rate (rad/s) and acceleration (m/s²)."""


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
        if not is_compiled(self.library_model):
            compiled_dynamics(self.library_model)

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
        rates = equations(self.library_model, parameters)
        compiled = compiled_vehicle(self.library_model, parameters)
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
            return compiled.advance(z, v, duration_s, tolerances), t_s

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
    sideways, rate, yaw, lateral = x0.tolist()
    slip = math.atan2(-sideways, speed)
    return [0.0, -lateral, 0.0, math.hypot(sideways, speed), yaw, rate, slip]


def _output(z: Vector, parameters: Parameters) -> Vector:
    return np.array([-z[3] * math.sin(z[6]), z[5], z[4], -z[1]])


def _start_kinematic(x0: Vector, speed: float, parameters: Parameters) -> list[float]:
    # The reference point of this model is the rear axle; V follows from r, and the steering sets r.
    _, rate, yaw, lateral = x0.tolist()
    steering = math.atan(rate * (parameters.a + parameters.b) / speed)
    return [0.0, -lateral - parameters.b * math.sin(yaw), steering, speed, yaw]


def _output_kinematic(z: Vector, parameters: Parameters) -> Vector:
    behind, wheelbase = parameters.b, parameters.a + parameters.b
    rate = z[3] * math.tan(z[2]) / wheelbase
    return np.array([-behind * rate, rate, z[4], -z[1] - behind * math.sin(z[4])])


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


class CompiledVehicle:
    """A vehicle's compiled equations and their integrator."""

    def __init__(self, advance: Compiled, parameters: Parameters) -> None:
        self._advance = advance
        self._parameters = _record(parameters)
        self._work = buffers(0, _WHEELS)

    @property
    def cambers(self) -> Vector:
        """The wheels' camber angles at the last evaluation, (4,), rad."""
        return self._work.values.copy()

    def rates(self, z: Vector, steering: float, acceleration: float) -> Vector:
        """Return ż; see :data:`Rates`."""
        v = np.array([steering, 0.0, acceleration, 0.0])
        self.advance(z.copy(), v, 0.0, (1.0, 1.0))
        slope: Vector = self._work.slopes[0].copy()
        return slope

    def advance(self, z: Vector, v: Vector, duration_s: float, tolerances: tuple[float, float]) -> int:
        """Advance z in place; return a status code of the integrator.

        Args:
            z: the state, (N,).
            v: (4,) The steering rate is v₀ + v₁ δ, the acceleration v₂ + v₃ · speed.
            duration_s: the time to advance by.
            tolerances: relative and absolute tolerance of a step.
        """
        if len(self._work.point) != len(z):
            self._work = buffers(len(z), _WHEELS)
        code: int = self._advance(z, v, self._parameters, duration_s, tolerances, self._work)
        return code


def library(module: str, name: str | None = None) -> Any:
    """Return an attribute of a module of the library; by default the function of the same name."""
    return getattr(import_module(f"{_LIBRARY}.{module}"), name or module)


def equations(model: str, parameters: Parameters) -> Rates:
    """Return the equations of a model (the library's name, e.g. ``st``) for a vehicle."""
    if (compiled := compiled_vehicle(model, parameters)) is not None:
        return compiled.rates
    dynamics = _dynamics(model)
    return lambda z, *inputs: np.array(dynamics(z.tolist(), list(inputs), parameters))


def compiled_vehicle(model: str, parameters: Parameters) -> CompiledVehicle | None:
    """Return a vehicle's compiled equations; None if they run as Python code."""
    advance = compiled_dynamics(model)
    return None if advance is None else CompiledVehicle(advance, parameters)


@cache
def compiled_dynamics(model: str) -> Compiled | None:
    """Return a model's compiled integrator; None if its equations run as Python code.

    The first call on a machine compiles them, which takes long.
    """
    if model not in _COMPILED:
        return None
    import numba  # an extra of noack
    from numba.core.errors import NumbaError

    if not is_compiled(model):
        _print(while_compiling("the vehicle's equations", is_cached=_folder(model) is not None))
    compiled = _compiled(model)
    example = (
        np.zeros(1),
        np.zeros(4),
        _record(library("vehicle_parameters", "VehicleParameters")()),
        0.0,
        (0.0, 0.0),
        buffers(1, _WHEELS),
    )
    try:
        compiled.compile(tuple(map(numba.typeof, example)))
    except NumbaError as error:  # numba may not support another version of the library
        reason = str(error).partition("\n")[0]
        _print(f"warning: the vehicle's equations stay slow, as they cannot be compiled: {reason}")
        return None
    return compiled


def is_compiled(model: str) -> bool:
    """Whether the equations of a model need no compilation on this machine."""
    return model not in _COMPILED or is_kept(_folder(model), _integrator(_dynamics(model)))


def _dynamics(model: str) -> FunctionType:
    dynamics: FunctionType = library(f"vehicle_dynamics_{model}")
    return dynamics


def _print(line: str) -> None:
    with suppress(OSError, ValueError):  # stderr is closed
        print(f"noack: {line}", file=sys.stderr, flush=True)


def _integrator(dynamics: FunctionType) -> Callable[..., int]:
    def integrate(
        z: Vector,
        v: Vector,
        parameters: Parameters,
        duration_s: float,
        tolerances: tuple[float, float],
        work: StepBuffers,
    ) -> int:
        return advance(rates, dynamics, z, v, parameters, duration_s, tolerances, work)

    return integrate


def rates(
    dynamics: FunctionType,
    z: Vector,
    v: Vector,
    parameters: Parameters,
    signs: Vector,
    cambers: Vector,
    slope: Vector,
) -> None:
    """Write ż with the sign of each wheel's camber held, and the cambers; for compiled code."""
    tyre = parameters[0].tire
    tyre.wheel = 0
    for k in range(_WHEELS):
        tyre.signs[k] = signs[k]
    inputs = (v[0] + v[1] * z[2], v[2] + v[3] * z[3])
    derivatives = dynamics(z.copy(), inputs, parameters[0])  # it modifies z
    for n in range(len(derivatives)):
        slope[n] = derivatives[n]
    for k in range(_WHEELS):
        cambers[k] = tyre.cambers[k]


def _compiled(model: str) -> Compiled:
    from numba.extending import overload, register_jitable  # an extra of noack

    dynamics, lateral = _dynamics(model), library("utils.tire_model", "formula_lateral")
    integrator_functions = [member for _, member in inspect.getmembers(jump_integrator, inspect.isfunction)]
    functions: set[Callable[..., Any]] = {*_with_callees(dynamics), *integrator_functions, rates}
    for function in functions - {lateral}:
        register_jitable(**_OPTIONS)(function)
    overload(lateral, jit_options=_OPTIONS)(_held)
    return compiler(_folder(model), error_model="python")(_integrator(dynamics))


def _held(alpha: Any, gamma: Any, F_z: Any, p: Any) -> Any:
    """Return the library's formula for the lateral force, with the sign of the camber held.

    The library calls it for one wheel after the other. Its shifts are s (p₁ + p₃ |γ|) with the sign
    s of the camber γ. With −p₁ instead of p₁ it computes them for the other sign.
    """
    from numba.extending import register_jitable  # an extra of noack

    original = library("utils.tire_model", "formula_lateral")
    formula = FunctionType(original.__code__, original.__globals__)
    register_jitable(**_OPTIONS)(formula)

    def lateral(alpha: Any, gamma: Any, F_z: Any, p: Any) -> Any:
        wheel = p.wheel
        p.wheel = wheel + 1
        p.cambers[wheel] = gamma
        turned = p.signs[wheel] * gamma < 0.0
        if turned:
            p.p_hy1, p.p_vy1 = -p.p_hy1, -p.p_vy1
        force = formula(alpha, gamma, F_z, p)
        if turned:
            p.p_hy1, p.p_vy1 = -p.p_hy1, -p.p_vy1
        return force

    return lateral


@cache
def _folder(model: str) -> Path | None:
    sources = {Path(inspect.getfile(function)) for function in _with_callees(_dynamics(model))}
    sources |= {Path(__file__), Path(jump_integrator.__file__)}
    return cache_folder(f"vehicle-{model}", sorted(sources))


def _with_callees(function: FunctionType) -> list[FunctionType]:
    """Return a function of the library and all library functions that it calls, also indirectly."""
    functions = [function]
    for caller in functions:  # grows
        functions += [callee for callee in dict.fromkeys(_callees(caller)) if callee not in functions]
    return functions


def _callees(function: FunctionType) -> Iterator[FunctionType]:
    names = function.__code__.co_names
    reachable = [function.__globals__.get(name) for name in names]
    for module in [value for value in reachable if isinstance(value, ModuleType)]:
        reachable += [getattr(module, name, None) for name in names]
    for value in reachable:
        if isinstance(value, FunctionType) and value.__module__.partition(".")[0] == _LIBRARY:
            yield value


def _record(parameters: Parameters) -> NDArray[np.void]:
    """A vehicle's parameters as an array of one record; its type is the same for all vehicles."""

    def convert(section: Any) -> tuple[list[Any], tuple[Any, ...]]:
        types: list[Any] = []
        values: list[Any] = []
        for field in fields(section):
            kind: Any = np.float64
            value = getattr(section, field.name)
            if is_dataclass(value):
                kind, value = convert(value)
            types.append((field.name, kind))
            values.append(np.nan if value is None else value)
        if type(section).__name__ == "TireParameters":
            types += [(name, kind) for name, kind, _ in _TYRE_FIELDS]
            values += [value for _, _, value in _TYRE_FIELDS]
        return types, tuple(values)

    dtype, values = convert(parameters)
    return np.array([values], dtype=dtype)

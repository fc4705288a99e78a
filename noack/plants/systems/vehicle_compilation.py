"""Compiles the vehicle models of CommonRoad that have tyres, with their integrator.

Compiled code integrates them, and locates their jumps: a tyre's lateral force jumps where the wheel's
camber changes its sign. The small models run as Python code, with scipy's integrator. For them a
call of compiled code costs more time than it saves, because it needs more of the processor's caches,
which other code overwrites between two steps.
"""

import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Vector
from noack.plants.systems import jump_integrator
from noack.plants.systems.code_cache import CALLED_BY_CODE, cache_folder, compiler, is_kept, while_compiling
from noack.plants.systems.jump_integrator import StepBuffers, advance, buffers

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


class CompiledVehicle:
    """A vehicle's compiled equations and their integrator."""

    def __init__(self, integrator: Compiled, parameters: Parameters) -> None:
        self._integrator = integrator
        self._parameters = _record(parameters)
        self._work = buffers(0, _WHEELS)

    @property
    def cambers(self) -> Vector:
        """The wheels' camber angles at the last evaluation, (4,), rad."""
        return self._work.values.copy()

    def rates(self, z: Vector, steering: float, acceleration: float) -> Vector:
        """Return ż; see :data:`Rates`."""
        v = np.array([steering, 0.0, acceleration, 0.0])
        self.advance_in_place(z.copy(), v, 0.0, (1.0, 1.0))
        slope: Vector = self._work.slopes[0].copy()
        return slope

    def advance_in_place(
        self, z: Vector, v: Vector, duration_s: float, tolerances: tuple[float, float]
    ) -> int:
        """Advance z; return a status code of the integrator.

        Args:
            z: the state, (N,).
            v: (4,) The steering rate is v₀ + v₁ δ, the acceleration v₂ + v₃ · speed.
            duration_s: the time to advance by.
            tolerances: relative and absolute tolerance of a step.
        """
        if len(self._work.point) != len(z):
            self._work = buffers(len(z), _WHEELS)
        code: int = self._integrator(z, v, self._parameters, duration_s, tolerances, self._work)
        return code


def library(module: str, name: str | None = None) -> Any:
    """Return an attribute of a module of the library; by default the function of the same name."""
    return getattr(import_module(f"{_LIBRARY}.{module}"), name or module)


def model_rates(model: str, parameters: Parameters) -> Rates:
    """Return the equations of a model (the library's name, e.g. ``st``) for a vehicle."""
    if (compiled := compiled_vehicle(model, parameters)) is not None:
        return compiled.rates
    dynamics = _dynamics(model)
    return lambda z, *inputs: np.array(dynamics(z.tolist(), list(inputs), parameters))


def compiled_vehicle(model: str, parameters: Parameters) -> CompiledVehicle | None:
    """Return a vehicle's compiled equations; None if they run as Python code."""
    integrator = compiled_dynamics(model)
    return None if integrator is None else CompiledVehicle(integrator, parameters)


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
    compiled = _make_compilable(model)
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
        return advance(rates_with_held_cambers, dynamics, z, v, parameters, duration_s, tolerances, work)

    return integrate


def rates_with_held_cambers(
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


def _make_compilable(model: str) -> Compiled:
    from numba.extending import overload, register_jitable  # an extra of noack

    dynamics, lateral = _dynamics(model), library("utils.tire_model", "formula_lateral")
    integrator_functions = [member for _, member in inspect.getmembers(jump_integrator, inspect.isfunction)]
    functions: set[Callable[..., Any]] = {
        *_with_callees(dynamics),
        *integrator_functions,
        rates_with_held_cambers,
    }
    for function in functions - {lateral}:
        register_jitable(**_OPTIONS)(function)
    overload(lateral, jit_options=_OPTIONS)(_lateral_force_with_held_camber)
    return compiler(_folder(model), error_model="python")(_integrator(dynamics))


def _lateral_force_with_held_camber(alpha: Any, gamma: Any, F_z: Any, p: Any) -> Any:
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

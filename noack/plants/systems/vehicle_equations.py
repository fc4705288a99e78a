"""The equations of CommonRoad's vehicle models, unchanged; those with tyre models are compiled.

As Python code, the multi-body model takes three times as long, which is too long for 500 Hz. The
small models run as Python code. For them a call of compiled code costs more time than it saves,
because it needs more of the processor's caches, which other code overwrites between two steps.
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

from noack.core.code_cache import cache_folder, compiler, is_kept, while_compiling
from noack.core.linear_systems import Vector

_LIBRARY = "vehiclemodels"
_COMPILED = ("std", "mb")

Rates = Callable[[Vector, float, float], Vector]
"""ż as a function of z (N,), steering rate (rad/s) and acceleration (m/s²)."""


def library(module: str, name: str | None = None) -> Any:
    """Return an attribute of a module of the library; by default the function of the same name."""
    return getattr(import_module(f"{_LIBRARY}.{module}"), name or module)


def equations(model: str, parameters: Any) -> Rates:
    """Return the equations of a model (the library's name, e.g. ``st``) for a vehicle."""
    if (compiled := compiled_dynamics(model)) is None:
        dynamics = _dynamics(model)
        return lambda z, *inputs: np.array(dynamics(z.tolist(), list(inputs), parameters))
    values = _record(parameters)

    def rates(z: Vector, steering: float, acceleration: float) -> Vector:
        found = np.empty_like(z)
        compiled(z, steering, acceleration, values, found)
        return found

    return rates


@cache
def compiled_dynamics(model: str) -> Any:
    """Return a model's compiled equations; None if they run as Python code.

    The first call on a machine compiles them, which takes long.
    """
    if model not in _COMPILED:
        return None
    import numba
    from numba.core.errors import NumbaError

    if not is_compiled(model):
        _print(while_compiling("the vehicle's equations", kept=_folder(model) is not None))
    compiled = _compiled(model)
    vector = numba.types.Array(numba.float64, 1, "C")
    dtype = _record(library("vehicle_parameters", "VehicleParameters")()).dtype
    parameters = numba.types.Array(numba.from_dtype(dtype), 1, "C")
    try:
        compiled.compile((vector, numba.float64, numba.float64, parameters, vector))
    except NumbaError as error:  # numba may not support another version of the library
        why = str(error).partition("\n")[0]
        _print(f"warning: the vehicle's equations stay slow, as they cannot be compiled: {why}")
        return None
    return compiled


def is_compiled(model: str) -> bool:
    """Whether the equations of a model need no compilation on this machine."""
    return model not in _COMPILED or is_kept(_folder(model), _of(_dynamics(model)))


def _dynamics(model: str) -> Any:
    return library(f"vehicle_dynamics_{model}")


def _print(line: str) -> None:
    with suppress(OSError, ValueError):  # stderr is closed
        print(f"noack: {line}", file=sys.stderr, flush=True)


def _of(dynamics: Callable[..., Any]) -> Callable[..., None]:
    def compute(
        z: Vector, steering: float, acceleration: float, parameters: Any, into: Vector
    ) -> None:
        rates = dynamics(z.copy(), (steering, acceleration), parameters[0])  # it modifies z
        for number in range(len(rates)):
            into[number] = rates[number]

    return compute


def _compiled(model: str) -> Any:
    from numba.extending import register_jitable

    dynamics = _dynamics(model)
    for function in _needed(dynamics):
        register_jitable(error_model="python")(function)
    return compiler(_folder(model), error_model="python")(_of(dynamics))


@cache
def _folder(model: str) -> Path | None:
    sources = {Path(inspect.getfile(function)) for function in _needed(_dynamics(model))}
    return cache_folder(f"vehicle-{model}", sorted({*sources, Path(__file__)}))


def _needed(function: FunctionType) -> list[FunctionType]:
    """Return a function of the library and all library functions that it calls, also indirectly."""
    needed = [function]
    for one in needed:  # grows
        needed += [other for other in dict.fromkeys(_named(one)) if other not in needed]
    return needed


def _named(function: FunctionType) -> Iterator[FunctionType]:
    names = function.__code__.co_names
    reachable = [function.__globals__.get(name) for name in names]
    for module in [one for one in reachable if isinstance(one, ModuleType)]:
        reachable += [getattr(module, name, None) for name in names]
    for one in reachable:
        if isinstance(one, FunctionType) and one.__module__.partition(".")[0] == _LIBRARY:
            yield one


def _record(parameters: Any) -> NDArray[np.void]:
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
        return types, tuple(values)

    dtype, values = convert(parameters)
    return np.array([values], dtype=dtype)

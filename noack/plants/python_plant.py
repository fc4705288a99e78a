"""A plant from a user's class: equations, or an object that advances itself.

The class's code runs in the plant's process. An exception in this code stops the plant's motion,
but not the run.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from typing import ClassVar, Literal

import numpy as np

from netem.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import (
    Names,
    OdeSystem,
    PlantEquations,
    PlantOutline,
    PlantSettings,
    PlantStart,
    PlantSystem,
    SystemFailedError,
    name_and_unit,
)
from noack.settings.user_files import ClassSettings, UserCode, new_instance, read_only, real_vector, user_code
from noack.settings.values import require_distinct, require_name

_PLACE = "plant.system"
_START_TOLERANCE = 1e-6
"""Largest relative difference between x(0) of the scenario and x(0) of the class."""


class PythonPlantSettings(ClassSettings, PlantSettings):
    """A user's class, from an installed package or a file.

    Its code runs in the plant's process; docs/plants.md lists the methods that it must have.
    """

    group: ClassVar = "noack.plants"
    has_equations: ClassVar = True
    runs_user_code: ClassVar = True

    kind: Literal["python"]
    on_record: Names = ()
    """Names of the entries of the class's own state z; if they are given, z is recorded."""

    @property
    def internal_names(self) -> tuple[str, ...]:
        return self.on_record

    def system(self, start: PlantStart) -> PlantSystem:
        return PythonSystem(self, start.x0, start.B.shape[1])

    def outline(self) -> PlantOutline | None:
        """Return what the class says in ``states``, ``inputs``, ``allowed`` and ``initial_state``."""
        with user_code(self, _PLACE, CallerError):
            plant, _ = new_instance(self, _PLACE)
            if not hasattr(plant, "states"):
                if getattr(plant, "allowed", None):
                    raise ValueError('allowed: of states without names; give states, e.g. ["angle, rad"]')
                return None
            states = _texts("states", plant.states)
            inputs = _texts("inputs", plant.inputs) if hasattr(plant, "inputs") else None
            names = [name_and_unit(state)[0] for state in states]
            allowed = getattr(plant, "allowed", {})
            if not isinstance(allowed, Mapping):
                raise ValueError(f'allowed is {allowed!r}; give errors by states, e.g. {{"angle": 0.02}}')
            for name, value in allowed.items():
                if name not in names:
                    raise ValueError(f"allowed: {name!r} is no state; the states are {', '.join(names)}")
                if not (isinstance(value, int | float) and 0 < value < math.inf):
                    raise ValueError(f"allowed[{name!r}] is {value!r}; give a positive number")
            start = getattr(plant, "initial_state", None)
            x0 = None if start is None else real_vector("initial_state", start, len(states))
        initial_state = None if x0 is None else tuple(x0.tolist())
        m = None if inputs is None else len(inputs)
        return PlantOutline(len(states), m, states, inputs, None, dict(allowed), initial_state)


def _texts(name: str, values: object) -> tuple[str, ...]:
    """Return names of states or inputs; raise ValueError unless they are texts."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f'{name} is {values!r}; give a list of names, e.g. ["angle, rad"]')
    texts = tuple(values)
    if not texts or not all(isinstance(text, str) and text for text in texts):
        raise ValueError(f'{name} is {values!r}; give a list of names, e.g. ["angle, rad"]')
    plain_names = tuple(name_and_unit(text)[0] for text in texts)
    for plain_name in plain_names:
        require_name(plain_name)
    require_distinct(plain_names, name)
    return texts


class PythonSystem:
    """An object of a user's class, at x(0).

    The class has one of two interfaces. The first is ``derivative(t_s, z, u)``, which returns dz/dt
    under the constant input u. If z differs from x, it also needs ``state(x0)`` and ``output(z)``.
    The second is ``start(x0)``, ``advance(u, t_s, dt_s)`` and ``x``, with ``z`` if z is to be
    recorded. ``docs/plants.md`` has examples.

    Raises:
        CallerError: the class does not exist, raises, or lacks a required method.
    """

    def __init__(self, settings: PythonPlantSettings, x0: Vector, m: int) -> None:
        self._recorded = len(settings.on_record)
        self._user_code = partial(user_code, settings, _PLACE, CallerError)
        with self._user_code():
            plant, self.about = new_instance(settings, _PLACE)
            self._system = self._make_system(plant, x0, m)
            self.x, self.z = x0, np.zeros(self._recorded)
            self._copy_state()
        self._user_code = partial(user_code, settings, _PLACE, SystemFailedError)
        if not np.all(np.abs(self.x - x0) <= _START_TOLERANCE * (np.abs(x0) + 1.0)):
            raise CallerError(
                f'{_PLACE}.name = "{settings.name}": x is {self.x.tolist()} at the start; '
                f"plant.initial_state is {x0.tolist()}"
            )

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        with self._user_code():
            self._system.advance(u, t_ns, dt_ns)
            self._copy_state()

    def rates(self, x: Vector, u: Vector) -> Vector | None:
        """Return dx/dt, (n,); None if the class has no derivative of x."""
        return self._system.rates(x, u) if isinstance(self._system, OdeSystem) else None

    def expressions(self, t_s: float, x: Vector, u: Vector) -> tuple[Vector, Vector] | None:
        """See :meth:`OdeSystem.expressions`; None if the class has no derivative."""
        with self._user_code():
            system = self._system
            return system.expressions(t_s, x, u) if isinstance(system, OdeSystem) else None

    def _copy_state(self) -> None:
        self.x = real_vector("x", self._system.x, len(self.x))
        if self._recorded:
            self.z = real_vector("z", self._system.z, self._recorded)

    def _make_system(self, plant: UserCode, x0: Vector, m: int) -> PlantSystem:
        if hasattr(plant, "derivative") == hasattr(plant, "advance"):
            methods = "both derivative and" if hasattr(plant, "advance") else "neither derivative nor"
            raise TypeError(f"it has {methods} advance; one of them is needed")
        if hasattr(plant, "advance"):
            return _Stepping(plant, x0)
        z0 = np.array(plant.state(x0.copy()) if hasattr(plant, "state") else x0, dtype=np.float64)
        if z0.ndim != 1:
            raise ValueError(f"state(x0) has shape {z0.shape}; a vector is needed")
        if self._recorded and self._recorded != len(z0):
            raise ValueError(f"z has {len(z0)} entries; plant.system.on_record names {self._recorded}")

        def derivative(t_s: float, z: Vector, u: Vector) -> Vector:
            with self._user_code():
                if z.dtype == object:  # enclosed numbers
                    with _numpy_for_math(plant.derivative):
                        return np.asarray(plant.derivative(t_s, read_only(z), read_only(u)))
                rates = plant.derivative(t_s, read_only(z), read_only(u))
                return real_vector("derivative(t_s, z, u)", rates, len(z0))

        derivative(0.0, z0, np.zeros(m))  # report its errors before the run
        output = plant.output if hasattr(plant, "output") else np.copy
        equations = PlantEquations(derivative, lambda _: z0, output=output, is_recorded=bool(self._recorded))
        return OdeSystem(equations, x0)


_OTHER_NAMES = {
    "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "asinh": "arcsinh",
    "acosh": "arccosh", "atanh": "arctanh", "pow": "float_power",
}  # fmt: skip
"""Functions of ``math`` that numpy has under another name."""
_NUMPY_OF_MATH = {
    name: getattr(np, _OTHER_NAMES.get(name, name))
    for name in dir(math)
    if hasattr(np, _OTHER_NAMES.get(name, name)) and not name.startswith("_") and name != "remainder"
}
_NUMPY_OF_MATH["hypot"] = lambda *entries: np.sqrt(sum(entry * entry for entry in entries))


@contextmanager
def _numpy_for_math(derivative: UserCode) -> Iterator[None]:
    """Let a user's function find numpy's functions where it uses those of ``math``.

    Those of ``math`` make a float of their argument, so they cannot be enclosed. What the function's
    module has of ``math`` is replaced while the equations are enclosed, and only then.
    """
    names = getattr(getattr(derivative, "__func__", derivative), "__globals__", {})
    functions = {getattr(math, name): function for name, function in _NUMPY_OF_MATH.items()
                 if callable(function)}  # fmt: skip
    replaced = dict[str, UserCode]()
    for name, value in names.items():
        if value is math:
            replaced[name] = SimpleNamespace(**{**vars(math), **_NUMPY_OF_MATH})
        elif type(value) is type(math.sin) and value in functions:
            replaced[name] = functions[value]
    kept = {name: names[name] for name in replaced}
    names.update(replaced)
    try:
        yield
    finally:
        names.update(kept)


class _Stepping:
    """An object that advances itself."""

    def __init__(self, plant: UserCode, x0: Vector) -> None:
        self._plant = plant
        plant.start(x0.copy())

    @property
    def x(self) -> UserCode:
        return self._plant.x

    @property
    def z(self) -> UserCode:
        return self._plant.z

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        self._plant.advance(u.copy(), t_ns * 1e-9, dt_ns * 1e-9)

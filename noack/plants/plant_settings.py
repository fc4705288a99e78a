"""The interface of a system that a plant advances, and the settings that every kind of plant has.

EquationSettings is the base of plants given by equations; OdeSystem integrates them.

The loop uses x and u, the deviations from an operating point. The plant's own state z may have
other coordinates, and more of them.
"""

import math
import re
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, ClassVar, NamedTuple, Protocol

import numpy as np
from pydantic import Field

from netem.core.errors import NoackError
from netem.core.settings_section import ScenarioSection, Table
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.wire_format import MAX_DIMENSION

Names = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(max_length=MAX_DIMENSION)]
Derivative = Callable[[float, Vector, Vector], Sequence[float] | Vector]
"""dz/dt = f(t, z, v), with t in seconds, z (N,) and the physical input v (m,)."""
_MAX_STEPS = 10_000
"""Most steps of the integrator from one sample to the next."""
_RELATIVE, _ABSOLUTE = 1e-9, 1e-12
"""Tolerances of each step of the integrator; the absolute one in z's units."""
_ESCAPE = 1e4
"""If a state grows by this factor within a step of the plant, it has diverged."""
_GAVE_UP = {
    -2: f"the integrator needs more than {_MAX_STEPS:,} steps from one sample to the next",
    -3: "the integrator's steps become too small",
    -4: "they are too stiff for an explicit integrator",
}
"""Status codes of dopri5, as text."""
_JUMPING = "; if they jump, as with np.sign(v), write np.tanh(v / w) with a small w instead"
"""What ends the most frequent reason: at rest, dry friction as a sign jumps at each step."""


class SystemFailedError(NoackError):
    """A system cannot continue; the message is one line that names the system."""


class PlantSystem(Protocol):
    """A system that holds its own state.

    Its motion is a function of its start and of the steps since then: the same steps give the same
    bits, so a run can be replayed.
    """

    @property
    def x(self) -> Vector:
        """The state of the loop: the deviation from the operating point, shape (n,)."""

    @property
    def z(self) -> Vector:
        """The system's own state, shape (N,); empty if x is the whole state."""

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Advance from ``t_ns`` by ``dt_ns`` under the constant input ``u``.

        Args:
            u: deviation from the operating point's input, shape (m,).
            t_ns: simulated time since the run's epoch.
            dt_ns: length of the step.

        Raises:
            SystemFailedError: the system cannot continue; do not advance it again.
        """


class PlantStart(NamedTuple):
    """The inputs of a plant besides its settings."""

    x0: Vector
    """x(0), (n,)."""
    A: Matrix
    """The true A of a linear plant, (n, n); Â for other plants."""
    B: Matrix
    """The true B of a linear plant, B̂ for other plants, (n, m). If the state is disturbed, the
    disturbance is a further input: (n, m + n)."""
    step_ns: int
    """Step of the plant."""


def name_and_unit(text: str) -> tuple[str, str]:
    """Return the name and the unit of a state or input that is described as "angle, rad"."""
    name, comma, unit = text.rpartition(", ")
    return (name, unit) if comma else (text, "")


def plain_name(text: str) -> str:
    """Return the name of a state or input that is described as "shaft angle, rad": shaft_angle."""
    return re.sub(r"\W", "_", name_and_unit(text)[0])


class PlantOutline(NamedTuple):
    """What a plant's settings say of it without a scenario."""

    n: int
    """Number of states."""
    m: int | None
    """Number of inputs; None: they do not say."""
    states: tuple[str, ...] | None = None
    """Names of the states, if they have any, perhaps with units: "angle, rad"."""
    inputs: tuple[str, ...] | None = None
    """Names of the inputs, if they have any."""
    rate_hz: float | None = None
    """Steps per second, if only steps of one length are possible."""
    allowed: Mapping[str, float] = MappingProxyType({})
    """Allowed errors of states, by their names without units."""
    initial_state: tuple[float, ...] | None = None
    """x(0), if it is known."""


class PlantSettings(ScenarioSection):
    """Settings of a plant."""

    states: ClassVar[tuple[str, ...]] = ()
    """Names of the entries of x, with units; empty if the model names them."""
    inputs: ClassVar[tuple[str, ...]] = ()
    """Names of the entries of u, with units; empty if the model names them."""
    has_own_step: ClassVar[bool] = False
    """Whether the system makes steps of one length only, which the plant's rate must be."""
    has_operating_point: ClassVar[bool] = False
    """Whether it has ``operating_state`` and ``operating_input``, from which x and u deviate."""
    has_equations: ClassVar[bool] = False
    """Whether the system may have equations that can be enclosed, for a certificate on a region."""
    runs_user_code: ClassVar[bool] = False
    """Whether the system is a class of the user's."""
    scenario: ClassVar[str | None] = None
    """A shipped scenario with this kind, for tests and benchmarks."""

    kind: str
    """The kind of plant."""

    @property
    def internal_names(self) -> tuple[str, ...]:
        """Names of the entries of z that are recorded; empty if z is not recorded."""
        return ()

    @classmethod
    def named_by(cls, label: str) -> Table | None:
        """Return the table ``plant.system`` of the plant that a text names; None if it names none.

        With it, ``noack linearise``, ``gain`` and ``new`` take such a text, e.g. a file's name.

        Raises:
            CallerError: the text names a plant that cannot be read.
        """
        return None

    def outline(self) -> PlantOutline | None:
        """Return what the settings say of the plant; None if they do not determine its size.

        Raises:
            CallerError: the plant cannot be read.
        """
        return None

    def check(self, n: int, m: int) -> None:
        """Require that this kind of plant can have n states and m inputs.

        Raises:
            ValueError: it cannot.
        """
        for title, names, count in (("states", self.states, n), ("inputs", self.inputs, m)):
            if names and len(names) != count:
                raise ValueError(
                    f"plant.system: it has {len(names)} {title} ({', '.join(names)}); the model has {count}"
                )

    def linearisation(self) -> tuple[Matrix, Matrix] | None:
        """Return A and B at the operating point, (n, n) and (n, m), if they are known exactly.

        If it returns None, A and B are computed from the system, by finite differences.
        """
        return None

    @abstractmethod
    def system(self, start: PlantStart) -> PlantSystem:
        """Return the system at x(0).

        Raises:
            CallerError: a file or module that the plant needs is missing, or differs from the
                settings.
        """


def _same(values: Vector) -> Vector:
    return values


@dataclass(frozen=True)
class PlantEquations:
    """``dz/dt = f(t, z, v)`` with x = output(z) and v = physical(u)."""

    derivative: Derivative  # f
    initial: Callable[[Vector], Vector] = _same  # z(0), (N,), as a function of x(0), (n,)
    output: Callable[[Vector], Vector] = _same  # x, (n,), as a function of z
    physical: Callable[[Vector], Vector] = _same  # v, (m,), as a function of u
    is_recorded: bool = False  # Whether z is recorded


class EquationSettings(PlantSettings):
    """Settings of a plant that is given by differential equations."""

    has_equations: ClassVar = True

    @abstractmethod
    def equations(self) -> PlantEquations:
        """Return the equations.

        Raises:
            CallerError: the settings exclude each other.
        """

    def system(self, start: PlantStart) -> PlantSystem:
        """Return a system that integrates the equations from x(0) on."""
        return OdeSystem(self.equations(), start.x0)


class OdeSystem:
    """``dz/dt = f(t, z, v)`` under a constant input: Dormand & Prince's pair of orders 5 and 4.

    The integrator restarts at every step of the plant, because the input changes abruptly there. So
    the result depends on z, v and t alone, and a replay repeats it bit for bit. If z diverges, or f
    cannot be evaluated, z is NaN from then on: the run has diverged.
    """

    def __init__(self, equations: PlantEquations, x0: Vector) -> None:
        self._equations = equations
        self._state = np.array(equations.initial(x0), dtype=np.float64)
        self._raised: list[BaseException] = []
        # Imported here: it takes time and 40 MB, which plants without equations do not need.
        from scipy.integrate import ode

        self._integrator = ode(self._guarded)
        self._integrator.set_integrator(
            "dopri5",
            rtol=_RELATIVE,
            atol=_ABSOLUTE,
            nsteps=_MAX_STEPS,
            verbosity=-1,
        )

    @property
    def x(self) -> Vector:
        """The deviation from the operating point, shape (n,)."""
        return self._equations.output(self._state)

    @property
    def z(self) -> Vector:
        """The system's own state, shape (N,); empty if it is not recorded."""
        return self._state if self._equations.is_recorded else self._state[:0]

    def expressions(self, t_s: float, x: Vector, u: Vector) -> tuple[Vector, Vector] | None:
        """Return dz/dt and x, (n,), for z = z(0) + x − x(0); None if x has other entries than z.

        The numbers may be of any kind, in arrays of objects.
        """
        x_now = self.x
        if len(x_now) != len(self._state):
            return None
        z, equations = self._state + (x - x_now), self._equations
        rates = equations.derivative(t_s, z, equations.physical(u))
        return np.asarray(rates), equations.output(z)

    def rates(self, x: Vector, u: Vector) -> Vector | None:
        """Return dx/dt at t = 0, (n,); None unless x is z, or z minus a constant."""
        output, x_now = self._equations.output, self.x
        off = 1e-3 * np.arange(1.0, len(x_now) + 1)
        if len(x_now) != len(self._state):
            return None
        if not (np.abs(output(self._state + off) - x_now - off) <= 1e-9).all():
            return None
        try:
            rates = self._equations.derivative(0.0, self._state + (x - x_now), self._equations.physical(u))
        except (ArithmeticError, ValueError):  # outside the equations' domain
            return np.full_like(x_now, np.nan)
        return np.asarray(rates, dtype=np.float64)

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Integrate over one step.

        Raises:
            SystemFailedError: the tolerance cannot be met, although f is finite.
            BaseException: f raised an exception that is not an arithmetic error.
        """
        v = self._equations.physical(u)
        self._raised.clear()
        reached, t_s = self._state.copy(), t_ns * 1e-9
        self._integrator.set_f_params(v)
        self._integrator.set_initial_value(reached, t_s)
        with warnings.catch_warnings(action="ignore"):  # the status has the same information
            reached[:] = self._integrator.integrate(t_s + dt_ns * 1e-9)
        code, t_s = self._integrator.get_return_code(), self._integrator.t
        for error in self._raised:
            # Far outside the equations' domain an arithmetic error is divergence.
            if not isinstance(error, ArithmeticError | ValueError):
                raise error
            reached = np.full_like(self._state, np.nan)
        if code < 0:
            self._require_divergence(reached, v, t_s, code)
            reached = np.full_like(self._state, np.nan)
        self._state = reached

    def _require_divergence(self, z: Vector, v: Vector, t_s: float, code: int) -> None:
        """Raise SystemFailedError if the integrator gave up although f is finite and z small."""
        with np.errstate(all="ignore"):
            slope = np.asarray(self._guarded(t_s, z, v))
            escaped = not np.linalg.norm(z) < _ESCAPE * np.linalg.norm(self._state)
        if np.isfinite(slope).all() and not escaped:
            reason = _GAVE_UP.get(code, "the tolerance cannot be met")
            raise SystemFailedError(
                f"the plant's equations cannot be integrated at {t_s:.6g} s: {reason}{_JUMPING}"
            )

    def _guarded(self, t_s: float, z: Vector, v: Vector) -> Sequence[float] | Vector:
        """Return f, or NaN after an exception: an exception cannot stop the integrator."""
        if not self._raised:
            try:
                return self._equations.derivative(t_s, z, v)
            except BaseException as error:
                self._raised.append(error)
        return np.full_like(z, np.nan)


def _of_number(name: str, of_float: Callable[[float], float]) -> Callable[[object], float]:
    """Return a function of floats, and of numbers that carry an enclosure.

    So equations with these functions, or numpy's, are the plant's motion and a certificate's
    evidence alike: evaluated with floats they give dx/dt, evaluated with the numbers of
    :mod:`noack.plants.systems.traced_equations` they give the steps to be enclosed. numpy's functions
    call a method of the same name of such a number, and so do these.
    """

    def function(x: object) -> float:
        if isinstance(x, float):
            return of_float(x)
        value: float = getattr(x, name)()  # stands for a float in the equations
        return value

    return function


sin = _of_number("sin", math.sin)
cos = _of_number("cos", math.cos)
sqrt = _of_number("sqrt", math.sqrt)


def at_least(x: object, low: float) -> float:
    """Return max(x, low) of a float, or of a number that carries an enclosure."""
    if isinstance(x, float):
        return max(x, low)
    value: float = x.maximum(low)  # type: ignore[attr-defined] # stands for a float in the equations
    return value

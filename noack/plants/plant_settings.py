"""The interface of a system that a plant advances, and the settings that every kind of plant has.

The loop uses x and u, the deviations from an operating point. The plant's own state z may have
other coordinates, and more of them.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol

from pydantic import Field

from noack.core.errors import CallerError, NoackError
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.wire_format import MAX_DIMENSION
from noack.settings.section import ScenarioSection

Names = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(max_length=MAX_DIMENSION)]
Derivative = Callable[[float, Vector, Vector], Sequence[float] | Vector]
"""dz/dt = f(t, z, v), with t in seconds, z (N,) and the physical input v (m,)."""
Advance = Callable[[Vector, Vector, float, float], tuple[int, float]]
"""Advances z (N,) in place under a constant v from a time by a duration, in seconds; returns a
status code of scipy's "dopri5", negative for a failure, and the time of the failure."""


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
        ...

    @property
    def z(self) -> Vector:
        """The system's own state, shape (N,); empty if x is the whole state."""
        ...

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Advance from ``t_ns`` by ``dt_ns`` under the constant input ``u``.

        Args:
            u: deviation from the operating point's input, shape (m,).
            t_ns: simulated time since the run's epoch.
            dt_ns: length of the step.

        Raises:
            SystemFailedError: the system cannot continue; do not advance it again.
        """
        ...


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


class PlantSettings(ScenarioSection):
    """Settings of a plant."""

    states: ClassVar[tuple[str, ...]] = ()
    """Names of the entries of x, with units; empty if the model names them."""
    inputs: ClassVar[tuple[str, ...]] = ()
    """Names of the entries of u, with units; empty if the model names them."""
    needs: ClassVar[tuple[str, str] | None] = None
    """The module that this kind needs, and the extra of noack that installs it."""
    scenario: ClassVar[str | None] = None
    """A shipped scenario with this kind, for tests and benchmarks."""
    variants: ClassVar[tuple[dict[str, Any], ...]] = ({},)
    """Settings that tests and benchmarks use one after the other."""

    kind: str
    """The kind of plant."""

    @property
    def settling_s(self) -> float:
        """Time after which x and u determine z; 0 if they determine it at all times."""
        return 0.0

    @property
    def internal_names(self) -> tuple[str, ...]:
        """Names of the entries of z that are recorded; empty if z is not recorded."""
        return ()

    def check(self, n: int, m: int) -> None:
        """Require that this kind of plant can have n states and m inputs.

        Raises:
            ValueError: it cannot.
        """
        for what, names, count in (("states", self.states, n), ("inputs", self.inputs, m)):
            if names and len(names) != count:
                raise ValueError(
                    f"plant.system: it has {len(names)} {what} ({', '.join(names)}); "
                    f"the model has {count}"
                )

    def require_installed(self) -> None:
        """Check that the module that this kind needs is installed.

        Raises:
            CallerError: it is not.
        """
        if self.needs is not None and find_spec(self.needs[0]) is None:
            raise CallerError(
                f'plant.system.kind: "{self.kind}" needs a package that is not installed; '
                f"pip install 'noack[{self.needs[1]}]'"
            )

    def linearisation(self) -> tuple[Matrix, Matrix] | None:
        """Return A and B at the operating point, (n, n) and (n, m), if they are known exactly.

        If it returns None, A and B are computed by finite differences of the system's motion.
        """
        return None

    def prepare(self) -> None:
        """Do the slow work that is needed once per machine, before a run: compile equations.

        Raises:
            CallerError: a module that the plant needs is not installed.
        """

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

    derivative: Derivative
    """f."""
    initial: Callable[[Vector], Vector] = _same
    """z(0), (N,), as a function of x(0), (n,)."""
    output: Callable[[Vector], Vector] = _same
    """x, (n,), as a function of z."""
    physical: Callable[[Vector], Vector] = _same
    """v, (m,), as a function of u."""
    relative: float = 1e-9
    """Relative tolerance of each step of the integrator."""
    absolute: float = 1e-12
    """Absolute tolerance, in z's units."""
    is_recorded: bool = False
    """Whether z is recorded."""
    advance: Advance | None = None
    """The equations' own integrator."""


class EquationSettings(PlantSettings):
    """Settings of a plant that is given by differential equations."""

    @abstractmethod
    def equations(self) -> PlantEquations:
        """Return the equations.

        Raises:
            CallerError: a module that the plant needs is not installed, or the settings exclude
                each other.
        """

    def system(self, start: PlantStart) -> PlantSystem:
        """Return a system that integrates the equations from x(0) on."""
        # The import of the integrator takes time and 40 MB. Other plants do not need it.
        from noack.plants.systems.ode_integrator import OdeSystem

        return OdeSystem(self.equations(), start.x0)

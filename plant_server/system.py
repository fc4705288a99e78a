"""What a plant steps through time: a system behind one interface, whatever moves it."""

from typing import Protocol

from noack.core.errors import NoackError
from noack.core.linear_systems import Vector


class SystemFailedError(NoackError):
    """A system cannot go on; what it says is one line that names it."""


class PlantSystem(Protocol):
    """A system that holds its own state.

    What it does is a function of its start and of the steps since: the same steps give the same
    bits, so that a run can be replayed.
    """

    @property
    def x(self) -> Vector:
        """What the loop calls the state: the deviation from the operating point, shape (n,)."""
        ...

    @property
    def z(self) -> Vector:
        """The system's own state, shape (N,); empty where x says all that is to be said."""
        ...

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Go from ``t_ns`` on for ``dt_ns`` under the held input ``u``.

        Args:
            u: deviation from the operating point's input, shape (m,).
            t_ns: simulated time since the run's epoch.
            dt_ns: length of the step.

        Raises:
            SystemFailedError: it cannot; it is not asked again.
        """
        ...

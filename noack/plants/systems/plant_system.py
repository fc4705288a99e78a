"""The interface of a system that a plant advances through time."""

from typing import Protocol

from noack.core.errors import NoackError
from noack.core.linear_systems import Vector


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

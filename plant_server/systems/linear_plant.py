"""A linear system, advanced exactly under a held input."""

import numpy as np

from noack.core.linear_systems import HeldInputPropagator, Matrix, Vector

_NOTHING = np.zeros(0)


class LinearSystem:
    """``dx/dt = A x + B u``, its own state being x.

    Args:
        A, B: shapes (n, n) and (n, m), per second.
        x0: x(0), shape (n,).
        step_ns: the step to prepare for; others are taken as well.
    """

    def __init__(self, A: Matrix, B: Matrix, x0: Vector, *, step_ns: int) -> None:
        self._advance = HeldInputPropagator(A, B)
        self._advance.step(step_ns)  # computed before the first deadline, not after it
        self.x = np.array(x0, dtype=np.float64)
        self.z = _NOTHING

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """x(t + dt) = Ad x(t) + Bd u."""
        self.x = self._advance(self.x, u, dt_ns)

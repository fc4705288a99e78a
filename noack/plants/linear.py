"""A linear system, advanced exactly under a constant input."""

from typing import ClassVar, Literal

import numpy as np

from noack.core.linear_systems import HeldInputPropagator, Matrix, Vector
from noack.plants.plant_settings import PlantSettings, PlantStart

_EMPTY = np.zeros(0)


class LinearSettings(PlantSettings):
    """ẋ = A x + B u; the plant's other keys define A and B."""

    scenario: ClassVar = "lane_following"

    kind: Literal["linear"] = "linear"

    def system(self, start: PlantStart) -> "LinearSystem":
        return LinearSystem(start.A, start.B, start.x0, step_ns=start.step_ns)


class LinearSystem:
    """``dx/dt = A x + B u``; z is empty.

    The matrices of the expected step are computed before the first deadline.
    """

    def __init__(self, A: Matrix, B: Matrix, x0: Vector, *, step_ns: int) -> None:
        self.A, self.B = A, B
        self._advance = HeldInputPropagator(A, B)
        self._advance.step(step_ns)
        self.x = np.array(x0, dtype=np.float64)
        self.z = _EMPTY

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """x(t + dt) = Ad x(t) + Bd u."""
        self.x = self._advance(self.x, u, dt_ns)

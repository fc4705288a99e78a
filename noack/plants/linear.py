"""A linear system, advanced exactly under a constant input."""

from typing import ClassVar, Literal

import numpy as np

from noack.core.linear_systems import Matrix, Vector, discretise, product
from noack.plants.plant_settings import PlantSettings, PlantStart

_EMPTY = np.zeros(0)


class LinearSettings(PlantSettings):
    """ẋ = A x + B u; the plant's other keys define A and B."""

    scenario: ClassVar = "lane_following"

    kind: Literal["linear"] = "linear"

    def system(self, start: PlantStart) -> "LinearSystem":
        return LinearSystem(start.A, start.B, start.x0)


class LinearSystem:
    """``dx/dt = A x + B u``; z is empty. A plant's steps of it are the core's."""

    def __init__(self, A: Matrix, B: Matrix, x0: Vector) -> None:
        self.A, self.B = A, B
        self.x = np.array(x0, dtype=np.float64)
        self.z = _EMPTY

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """x(t + dt) = Ad x(t) + Bd u."""
        Ad, Bd = discretise(self.A, self.B, dt_ns)
        self.x = product(Ad, self.x) + product(Bd, u)

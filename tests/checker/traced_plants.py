"""Plants with equations, and whether the linear plants that enclose them explain each point."""

from collections.abc import Callable
from typing import Any

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.theory.witnesses.coordinates import floats
from noack_equations import LinearPlants

Field = Callable[[Any, Any], Any]


class Plant:
    """A plant with equations."""

    def __init__(self, field: Field) -> None:
        self.field = field

    def expressions(self, t_s: Any, x: Any, u: Any) -> Any:
        """See :meth:`noack.plants.plant_settings.OdeSystem.expressions`."""
        return self.field(x, u), x


def unexplained(plants: LinearPlants, field: Field, z: Matrix) -> Vector:
    """Return by how much ẋ is outside the plants, for the best signals by a linear program, at points."""
    from scipy.optimize import linprog

    A, B, half_A, half_B, D = (floats(M) for M in plants[:5])
    n, k = len(A), D.shape[1]
    missed = []
    for point in z:
        x, u = point[:n], point[n:]
        left = np.array(field(x, u), dtype=float) - A @ x - B @ u
        room = half_A @ np.abs(x) + half_B @ np.abs(u) + 1e-9
        # p with |p| ≤ 1 and p·Cz ≥ k p², so that p is between 0 and Cz/k: |left − D p| ≤ room.
        limits = []
        for row, least in plants.along:
            along = float((floats(row) @ point)[0])
            if not floats(row).any():
                limits.append((-1.0, 1.0))
                continue
            most = 1.0 if float(least) == 0 else min(abs(along) / float(least), 1.0)
            limits.append(
                (0.0, most + 1e-9) if along > 0 else (-most - 1e-9, 0.0) if along < 0 else (-1.0, 1.0)
            )
        columns = np.vstack([np.hstack([s * D, -np.ones((n, 1))]) for s in (1, -1)])
        sides = np.concatenate([left + room, room - left])
        answer = linprog([0.0] * k + [1.0], columns, sides, bounds=[*limits, (None, None)])
        assert answer.x is not None
        missed.append(answer.x[-1])
    return np.array(missed)

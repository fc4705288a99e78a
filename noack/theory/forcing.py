"""The disturbances of a plant, as a certificate counts them."""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector


class NormalForcing(NamedTuple):
    """Disturbances D ξ, ξ of k independent standard normal values, constant over each period."""

    columns: Matrix
    """D, (n, k)."""
    period_s: float
    limit: float
    """Assumed bound of every single value of ξ."""
    radius: float
    """Assumed bound of ‖v‖ for n independent standard normal values v, at every period's end."""


class Forcing(NamedTuple):
    """Disturbances: ẋ = Ax + Bu + Σ_i D_i s_i, |s_i| ≤ 1 at every time, and normal ones."""

    columns: Matrix
    """D_i, (n, k)."""
    durations_s: Vector
    """The time for which s_i is not 0, (k,); infinite if it never ends."""
    at_input: Vector
    """Bound of what is added to u, included in the columns, (m,)."""
    normal: NormalForcing | None = None

    @property
    def limited(self) -> Matrix:
        """Columns with the bounds of all values, normal ones included, (n, k')."""
        if self.normal is None:
            return self.columns
        return np.hstack([self.columns, self.normal.limit * self.normal.columns])

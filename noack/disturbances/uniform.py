"""A random disturbance with a bound."""

from typing import ClassVar, Literal

import numpy as np

from netem.core.random_streams import uniforms
from noack.core.linear_systems import Matrix, Vector
from noack.disturbances.disturbance_settings import DisturbanceSettings, SignalSource
from noack.settings.values import Bounds


class UniformDisturbance(DisturbanceSettings):
    """A new value at every step, uniformly distributed within a bound."""

    entries_key: ClassVar = "bound"
    example: ClassVar = {"kind": "uniform", "bound": [0.3]}

    kind: Literal["uniform"]
    bound: Bounds
    """Largest absolute value, entry by entry."""

    @property
    def variance(self) -> Vector:
        return np.square(self.bound) / 3

    def extent(self) -> Matrix:
        return np.diag(self.bound)

    def signal(self, steps: range, source: SignalSource) -> Matrix:
        unit = uniforms(source.seed, *source.stream, rows=steps, width=len(self.bound))
        return np.asarray(np.array(self.bound) * (2.0 * unit - 1.0))

"""A random disturbance without a bound."""

from typing import ClassVar, Literal

import numpy as np

from netem.core.random_streams import normals
from noack.core.linear_systems import Matrix, Vector
from noack.disturbances.disturbance_settings import DisturbanceSettings, SignalSource
from noack.settings.values import Deviations


class GaussianDisturbance(DisturbanceSettings):
    """A new value at every step, normally distributed around 0."""

    entries_key: ClassVar = "std"
    example: ClassVar = {"kind": "gaussian", "std": [0.2]}

    kind: Literal["gaussian"]
    std: Deviations
    """Standard deviation of the value of a step, entry by entry."""

    @property
    def variance(self) -> Vector:
        return np.square(self.std)

    def deviations(self) -> Matrix:
        return np.diag(self.std)

    def signal(self, steps: range, source: SignalSource) -> Matrix:
        unit = normals(source.seed, *source.stream, rows=steps, width=len(self.std))
        return np.asarray(np.array(self.std) * unit)

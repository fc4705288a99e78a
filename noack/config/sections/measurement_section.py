"""The measurement of the plant."""

from typing import Self

import numpy as np
from pydantic import model_validator

from noack.core.linear_systems import Vector
from noack.settings.matrices import Row, Rows, require_length, require_shape, require_squares
from noack.settings.section import ScenarioSection


class MeasurementSection(ScenarioSection):
    """The measurement of the plant: y = C x + v."""

    C: Rows | None = None
    """C by rows, p x n; by default the identity: every state is measured."""
    noise_std: Row | None = None
    """Standard deviation of the normally distributed part of v, p entries; by default 0."""
    noise_bound: Row | None = None
    """Bound of the uniformly distributed part of v, p entries; by default 0."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_squares(self.noise_std or (), "noise_std", "standard deviations")
        require_squares(self.noise_bound or (), "noise_bound", "bounds")
        return self

    def outputs(self, n: int) -> int:
        """Number of measured outputs p of a plant of n states."""
        return n if self.C is None else len(self.C)

    def selects_all(self, n: int) -> bool:
        """Whether C is the identity."""
        return self.C is None or (
            np.shape(self.C) == (n, n) and bool((np.array(self.C) == np.eye(n)).all())
        )

    @property
    def is_noisy(self) -> bool:
        """Whether there is any noise."""
        return any(self.noise_std or ()) or any(self.noise_bound or ())

    def variance(self, n: int) -> Vector:
        """Variance of v, shape (p,)."""
        variance = np.zeros(self.outputs(n))
        if self.noise_std is not None:
            variance = variance + np.square(self.noise_std)
        return variance if self.noise_bound is None else variance + np.square(self.noise_bound) / 3

    def check(self, n: int, why: str) -> None:
        """Raise ValueError, with the key, unless the shapes fit a model of n states."""
        place, p = "plant.measurement", self.outputs(n)
        require_shape(self.C, f"{place}.C", (p, n), f"{why}; one row per output")
        for key in ("noise_std", "noise_bound"):
            require_length(getattr(self, key), f"{place}.{key}", p, "one per measured output")

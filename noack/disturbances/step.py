"""A disturbance that is constant while it lasts: a load, a gust of wind."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from netem.core.clock import NS_PER_S
from netem.core.settings_section import NonNegative
from noack.core.linear_systems import Matrix
from noack.disturbances.disturbance_settings import DisturbanceSettings, SignalSource
from noack.settings.values import Row


class StepDisturbance(DisturbanceSettings):
    """A constant from one time on, or between two times."""

    entries_key: ClassVar = "amplitude"
    example: ClassVar = {"kind": "step", "amplitude": [1.5], "from_s": 0.1, "until_s": 0.3}

    kind: Literal["step"]
    amplitude: Row
    """The constant, entry by entry."""
    from_s: NonNegative = 0.0
    """When it begins."""
    until_s: Annotated[FiniteFloat, Field(gt=0)] | None = None
    """When it ends; unless given, it lasts to the end of the run."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError("until_s: must be later than from_s")
        return self

    def extent(self) -> Matrix:
        return np.array(self.amplitude)[:, None]

    def signal(self, steps: range, source: SignalSource) -> Matrix:
        """The constant in steps that begin in [from_s, until_s), else 0."""
        t_ns = source.period.times_ns(np.array(steps))
        active = t_ns >= round(self.from_s * NS_PER_S)
        if self.until_s is not None:
            active &= t_ns < round(self.until_s * NS_PER_S)
        return np.outer(active, self.amplitude)

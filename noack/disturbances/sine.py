"""A periodic disturbance."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import FiniteFloat

from netem.core.settings_section import Positive
from noack.core.linear_systems import Matrix
from noack.disturbances.disturbance_settings import DisturbanceSettings, SignalSource
from noack.settings.values import Row


class SineDisturbance(DisturbanceSettings):
    """Amplitude · sin(2π hz t + phase)."""

    entries_key: ClassVar = "amplitude"
    example: ClassVar = {"kind": "sine", "amplitude": [0.5], "hz": 3.0, "phase_rad": 0.4}

    kind: Literal["sine"]
    amplitude: Row
    """Amplitude, entry by entry."""
    hz: Positive
    """Frequency."""
    phase_rad: FiniteFloat = 0.0
    """Phase at t = 0."""

    def extent(self) -> Matrix:
        return np.array(self.amplitude)[:, None]

    def signal(self, steps: range, source: SignalSource) -> Matrix:
        """The value at the beginning of each step."""
        t_s = source.period.times_ns(np.array(steps)) * 1e-9
        return np.outer(np.sin(2 * np.pi * self.hz * t_s + self.phase_rad), self.amplitude)

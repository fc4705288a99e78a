"""The settings and the interface that every kind of disturbance has.

A disturbance is a function of time, constant over each step of the plant. A disturbance at the
input is added to u after the actuator, where it is not measured. A disturbance at the state is w in
ẋ = Ax + Bu + w.
"""

from abc import abstractmethod
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from netem.core.periods import Period
from netem.core.settings_section import ScenarioSection, Table
from noack.core.linear_systems import Matrix, Vector
from noack.settings.values import Row

Place = Literal["input", "state"]


class SignalSource(NamedTuple):
    """The data, besides its settings, from which a signal is computed."""

    period: Period  # Step of the plant
    seed: int
    stream: tuple[str, ...]  # Name of the disturbance's own random stream


class DisturbanceSettings(ScenarioSection):
    """Settings of a disturbance."""

    entries_key: ClassVar[str]
    """The key that gives the disturbance's size, one entry per input or per state."""
    example: ClassVar[Table]
    """Settings of this kind with one entry, for property tests and benchmarks."""

    kind: str
    """The kind of disturbance."""
    at: Place = "input"
    """Where it enters: added to the input, or to ẋ (of a linear plant)."""

    @property
    def entries(self) -> Row:
        """The disturbance's size, one entry per input or per state."""
        row: Row = getattr(self, self.entries_key)
        return row

    @property
    def variance(self) -> Vector:
        """Variance of the random part of each entry; zeros if the disturbance is not random."""
        return np.zeros(len(self.entries))

    def extent(self) -> Matrix:
        """Return columns, (entries, k): the signal is their sum with k factors from −1 to 1."""
        return np.zeros((len(self.entries), 0))

    def deviations(self) -> Matrix:
        """Return columns, (entries, k), whose factors are standard normal, independent by step.

        The signal is the sum of what ``extent`` and ``deviations`` describe.
        """
        return np.zeros((len(self.entries), 0))

    @abstractmethod
    def signal(self, steps: range, source: SignalSource) -> Matrix:
        """Return the values that are added during the given steps, shape (len(steps), entries)."""

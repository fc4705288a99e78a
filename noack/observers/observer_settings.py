"""The settings that every kind of observer has; native/loop/observer.c is what it does."""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Self

import numpy as np

from noack.core.core_memory import CoreMemory
from noack.core.linear_systems import Matrix, Vector
from noack.observers.estimation_model import EstimationModel, NoiseVariances
from noack.settings.section import Row, ScenarioSection, require_length


class ObserverSettings(ScenarioSection):
    """Settings of an observer."""

    example: ClassVar[dict[str, Any]]
    """Settings of this kind for two states, one input and one output, for property tests."""

    kind: str
    """The kind of observer."""
    initial_estimate: Row | None = None
    """x̂ before the first measurement, n entries; by default x(0) if the sensor starts from it,
    else 0."""

    def check(self, n: int, m: int, p: int, noise: NoiseVariances) -> None:
        """Require settings that fit n states, m inputs, p outputs and the scenario's noise.

        Raises:
            ValueError: a setting does not fit; the message begins with the key.
        """
        require_length(self.initial_estimate, "observer.initial_estimate", n, "one per state")

    def resolved(self, A: Matrix, C: Matrix, period_ns: int) -> Self:
        """Return settings with an explicit gain, in place of data from which the gain is computed.

        A is Â^(T) between two measurements, T the period.

        Raises:
            CallerError: there is no such gain.
        """
        return self

    def assumed_model(self, model: EstimationModel, noise: NoiseVariances) -> EstimationModel:
        """Return the model with the covariances that the observer assumes."""
        return model

    @abstractmethod
    def steady_gain(self, assumed: EstimationModel) -> Matrix | None:
        """Return L in the steady state, (n, p); None if none is found."""

    @abstractmethod
    def gains(self, assumed: EstimationModel) -> Iterator[Matrix]:
        """Yield L of every measurement, (n, p), without end."""

    def fill(self, observer: Any, assumed: EstimationModel, x: Vector, memory: CoreMemory) -> None:
        """Fill all of a ``noack_observer`` but its kind, with x̂ before the first measurement."""
        (n, n), p = assumed.Ad.shape, len(assumed.C)
        memory.fill(observer, {
            "p": p, "Ad": assumed.Ad, "Bd": assumed.Bd, "C": assumed.C, "x": x, "t_ns": -1,
            "gain": np.zeros((n, p)), "scratch": np.zeros(3 * n * n + n * p + p * p + 2 * n + p),
        })  # fmt: skip

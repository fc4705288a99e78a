"""The settings and the interface that every kind of observer has."""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Protocol, Self

from noack.core.linear_systems import Matrix, Vector
from noack.observers.estimation_model import EstimationModel, NoiseVariances
from noack.settings.matrices import Row, require_length
from noack.settings.section import ScenarioSection


class StateObserver(Protocol):
    """Estimates a state from measurements."""

    x: Vector
    """x̂, shape (n,)."""

    def predict(self, u: Vector) -> None:
        """Advance x̂ by a step of the plant under an input, shape (m,)."""
        ...

    def correct(self, y: Vector) -> None:
        """Correct x̂ by a measurement, shape (p,)."""
        ...


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

    @abstractmethod
    def estimator(self, assumed: EstimationModel, x: Vector) -> StateObserver:
        """Return the observer, at x̂ before the first measurement."""

"""Settings of what disturbs a plant; :mod:`plant_server.disturbance_signal` computes it.

A disturbance is a function of time that is held from each step of the plant to the next. At the
input it is added to u behind the actuator, where nobody measures it; at the state it is w of
ẋ = Ax + Bu + w.
"""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, FiniteFloat, model_validator

from noack.core.linear_systems import Vector
from noack.settings.matrices import Row, require_length, require_squares
from noack.settings.section import NonNegative, Positive, ScenarioSection

Place = Literal["input", "state"]


class _Disturbance(ScenarioSection):
    @property
    def size(self) -> tuple[str, Row]:
        """The key that says how large it is, and its entries: one per input, or per state."""
        raise NotImplementedError

    @property
    def variance(self) -> Vector:
        """Of each entry, of what is random about it; zeros if nothing is."""
        return np.zeros(len(self.size[1]))


class UniformDisturbance(_Disturbance):
    """At every step anew, uniform within a bound."""

    kind: Literal["uniform"]
    """What the disturbance is."""
    at: Place = "input"
    """Where it enters: added to the input, or to ẋ (of a linear plant)."""
    bound: Row
    """Largest size, entry by entry."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_squares(self.bound, "bound", "bounds")
        return self

    @property
    def size(self) -> tuple[str, Row]:
        """The bound."""
        return "bound", self.bound

    @property
    def variance(self) -> Vector:
        """A third of the bound squared."""
        return np.square(self.bound) / 3


class GaussianDisturbance(_Disturbance):
    """At every step anew, normally distributed around 0."""

    kind: Literal["gaussian"]
    """What the disturbance is."""
    at: Place = "input"
    """Where it enters: added to the input, or to ẋ (of a linear plant)."""
    std: Row
    """Standard deviation, entry by entry, of what is held from one step to the next."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_squares(self.std, "std", "standard deviations")
        return self

    @property
    def size(self) -> tuple[str, Row]:
        """The standard deviation."""
        return "std", self.std

    @property
    def variance(self) -> Vector:
        """The standard deviation squared."""
        return np.square(self.std)


class SineDisturbance(_Disturbance):
    """Amplitude · sin(2π hz t + phase)."""

    kind: Literal["sine"]
    """What the disturbance is."""
    at: Place = "input"
    """Where it enters: added to the input, or to ẋ (of a linear plant)."""
    amplitude: Row
    """Amplitude, entry by entry."""
    hz: Positive
    """Frequency."""
    phase_rad: FiniteFloat = 0.0
    """Phase at t = 0."""

    @property
    def size(self) -> tuple[str, Row]:
        """The amplitude."""
        return "amplitude", self.amplitude


class StepDisturbance(_Disturbance):
    """A constant from one time on, or between two: a load, a gust."""

    kind: Literal["step"]
    """What the disturbance is."""
    at: Place = "input"
    """Where it enters: added to the input, or to ẋ (of a linear plant)."""
    amplitude: Row
    """Its value, entry by entry."""
    from_s: NonNegative = 0.0
    """Since when it is there."""
    until_s: Annotated[FiniteFloat, Field(gt=0)] | None = None
    """When it is gone; unless given, it stays."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError("until_s: must be later than from_s")
        return self

    @property
    def size(self) -> tuple[str, Row]:
        """The value."""
        return "amplitude", self.amplitude


AnyDisturbance = Annotated[
    UniformDisturbance | GaussianDisturbance | SineDisturbance | StepDisturbance,
    Discriminator("kind"),
]


def variance_at(place: Place, disturbances: tuple[AnyDisturbance, ...], entries: int) -> Vector:
    """Variance of what is random about all disturbances at one place, shape (entries,)."""
    found = [one.variance for one in disturbances if one.at == place]
    return np.asarray(np.sum([np.zeros(entries), *found], axis=0))


def require_disturbances(
    disturbances: tuple[AnyDisturbance, ...], n: int, m: int, *, linear: bool
) -> None:
    """Check that disturbances fit a plant.

    Args:
        disturbances: of the plant.
        n: number of states.
        m: number of inputs.
        linear: whether the plant is linear.

    Raises:
        ValueError: one does not; the message begins with the key.
    """
    for number, one in enumerate(disturbances):
        place = f"plant.disturbances.{number}"
        if one.at == "state" and not linear:
            raise ValueError(
                f'{place}.at: "state" is for linear plants; this one can be disturbed at "input"'
            )
        key, entries = one.size
        expected, why = (m, "one per input") if one.at == "input" else (n, "one per state")
        require_length(entries, f"{place}.{key}", expected, f'at = "{one.at}": {why}')

"""The true plant, its initial state, its measurement, and its behaviour without actuations."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from noack.config.feature_kinds import AnyDisturbance, AnyPlant
from noack.config.sections.model_section import require_read
from noack.core.linear_systems import Vector
from noack.disturbances.disturbance_settings import Place
from noack.observers.observer_settings import NoiseVariances
from noack.plants.linear import LinearSettings
from noack.settings.matrices import (
    Row,
    Rows,
    require_length,
    require_non_negative,
    require_shape,
    require_squares,
)
from noack.settings.section import RateHz, ScenarioSection, require_whole_period


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


class WatchdogSection(ScenarioSection):
    """The input of the plant when no actuation has arrived for too long."""

    timeout_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """The newest actuation is too old when its model state is older than this, in simulated time;
    by default 50 periods of the controller. If actuations cross the network, zero and model act by
    default as soon as an actuation is missing: after the time for which its inputs last, plus the
    longest delay."""
    policy: Literal["hold", "zero", "model"] = "hold"
    """hold: the plant keeps the last input of the newest actuation; zero: the input is 0; model:
    the input of the controller's model, propagated from the newest actuation, which then carries
    x_c."""


class PlantSection(ScenarioSection):
    """The true plant, unknown to sensor and controller, and how it is drawn."""

    system: AnyPlant = LinearSettings.model_construct()
    """The kind of plant: a table with ``kind``; by default a linear system."""
    draw: Literal["nominal", "uniform", "vertex", "given"] = "nominal"
    """nominal: the model itself; uniform: each entry within its half-width; vertex: each entry at
    one end of its half-width; given: the matrices A and B below."""
    uncertainty_A: Rows | None = None
    """Half-widths of the uncertainty box around Â, n x n."""
    uncertainty_B: Rows | None = None
    """Half-widths of the uncertainty box around B̂, n x m."""
    A: Rows | None = None
    """The true A, n x n, for draw = "given"."""
    B: Rows | None = None
    """The true B, n x m, for draw = "given"."""
    file: str | None = None
    """An .npz or .mat file with the true A and B, as for model.file."""
    names: dict[Literal["A", "B"], str] | None = None
    """Names of the arrays in the file, if they differ from A and B."""
    initial_state: Row
    """x(0), n entries."""
    initial_state_halfwidth: Row | None = None
    """x(0) is drawn uniformly within these distances of initial_state; n entries."""
    rate_hz: RateHz = 500.0
    """Steps per second of simulated time."""
    measure_every: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """Number of plant steps per measurement."""
    measurement: MeasurementSection = MeasurementSection.model_construct()
    disturbances: tuple[AnyDisturbance, ...] = ()
    """Disturbances of the plant; they add up."""
    watchdog: WatchdogSection = WatchdogSection.model_construct()

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_whole_period(self.rate_hz, "rate_hz")
        require_read(self.file, self.names)
        for key in ("A", "B"):
            matrix = getattr(self, key)
            if self.draw == "given" and matrix is None:
                raise ValueError(f'{key}: draw = "given" needs both matrices A and B')
            if self.draw != "given" and matrix is not None:
                raise ValueError(f'{key}: matrices are for draw = "given", not "{self.draw}"')
        if self.draw != "nominal" and not isinstance(self.system, LinearSettings):
            raise ValueError(
                f'draw: "{self.draw}" is for linear plants; a {self.system.kind} is what it is'
            )
        box = (self.uncertainty_A or ()) + (self.uncertainty_B or ())
        if self.draw in ("uniform", "vertex") and not box:
            raise ValueError(
                f'uncertainty_A: draw = "{self.draw}" needs uncertainty_A or uncertainty_B'
            )
        for key in ("uncertainty_A", "uncertainty_B"):
            for row in getattr(self, key) or ():
                require_non_negative(row, key)
        require_non_negative(self.initial_state_halfwidth or (), "initial_state_halfwidth")
        return self

    def noise_variances(self, n: int, m: int) -> NoiseVariances:
        """Variances of the random disturbances and of the measurement noise."""

        def at(place: Place, size: int) -> Vector:
            variances = [one.variance for one in self.disturbances if one.at == place]
            return np.asarray(np.sum([np.zeros(size), *variances], axis=0))

        return NoiseVariances(at("state", n), at("input", m), self.measurement.variance(n))

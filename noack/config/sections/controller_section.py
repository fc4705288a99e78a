"""The controller's clock and what it steers to."""

from typing import Annotated, Self

from pydantic import Field, FiniteFloat, model_validator

from noack.config.sections.rates import RateHz, require_whole_period
from noack.settings.matrices import Row
from noack.settings.section import ScenarioSection


class ControllerSection(ScenarioSection):
    """The controller's schedule, and what it steers to."""

    rate_hz: RateHz = 500.0
    """Control inputs per second of simulated time."""
    phase: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.5
    """Offset of its ticks from the plant's, in periods; half a period lets a fresh update act
    within the same period."""
    safe_input: Row | None = None
    """What the controller puts out while it knows no state, m entries; by default 0."""
    setpoint: Row | None = None
    """x_r, n entries: the state at which the loop is to rest; by default 0. It must be an
    equilibrium of the model, Âx_r + B̂u_r = 0; then u = K(x_c − x_r) + u_r."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_whole_period(self.rate_hz, "rate_hz")
        return self

"""The settings and the interface that every kind of controller has."""

from abc import abstractmethod
from typing import Annotated, ClassVar, Literal, NamedTuple, Protocol

from pydantic import Field, FiniteFloat

from netem.core.errors import NoackError
from netem.core.settings_section import ScenarioSection
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.wire_format import MAX_DIMENSION
from noack.references import AnyPiece
from noack.settings.values import RateHz, Row

MOST_PIECES = 10_000


class ControlModel(NamedTuple):
    """The data that a control law receives about the loop."""

    A: Matrix  # Â, (n, n)
    B: Matrix  # B̂, (n, m)
    K: Matrix  # The scenario's gain, (m, n): x_s and x_c follow Â + B̂K between updates
    period_s: float  # Time between two ticks


class ControlFailedError(NoackError):
    """A control law cannot continue; the message is one line that names the law."""


class ControlLaw(Protocol):
    """Computes the control input."""

    def update(self, t_s: float, x: Vector) -> None:
        """Process a state x(t), shape (n,), of a received update.

        Raises:
            ControlFailedError: the law cannot continue; it must not be used again.
        """

    def input(self, t_s: float, x_c: Vector, setpoint: tuple[Vector, Vector] | None) -> Vector:
        """Return u, shape (m,).

        Args:
            t_s: simulated time of the tick.
            x_c: the model state, shape (n,).
            setpoint: x_r and u_r, shapes (n,) and (m,); None is 0.

        Raises:
            ControlFailedError: the law cannot continue; it must not be used again.
        """


class ControllerSettings(ScenarioSection):
    """Settings of a controller."""

    is_linear: ClassVar[bool] = False
    """Whether u = K(x_c − x_r) + u_r, as the theory assumes."""

    kind: str
    """The kind of controller."""
    rate_hz: RateHz = 500.0
    """Control inputs per second of simulated time."""
    phase: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.5
    """Offset of the controller's ticks from the plant's steps, in periods; with half a period, a
    fresh update takes effect within the same period."""
    safe_input: Row | None = None
    """The input before the first update, and without one that may be used, m entries; by default 0."""
    setpoint: Row | None = None
    """x_r, n entries: the state at which the loop is to rest; by default 0. It must be an
    equilibrium of the model, Âx_r + B̂u_r = 0; then u = K(x_c − x_r) + u_r. A class receives both."""

    reference: Annotated[tuple[AnyPiece, ...], Field(min_length=1, max_length=MOST_PIECES)] | None = None
    """The reference that the loop follows in place of a set-point: pieces in the order of time,
    each a table with ``kind``. x_r and u_r follow from them by the model; u = K(x_c − x_r) + u_r. A class
    receives both."""

    update_timeout_s: Annotated[FiniteFloat, Field(ge=1e-6, le=1e9)] | None = None
    """Age of the newest update from which on it is no longer used; by default there is none."""
    timeout_input: Literal["safe", "hold"] = "safe"
    """The input from then on: `safe_input`, or the last one held."""

    predictions: Annotated[int, Field(ge=1, le=MAX_DIMENSION)] = 1
    """Number of inputs in an actuation: that of the tick, and those of the model for the following
    ticks. The plant applies each at its time, until a newer actuation arrives (packetised
    predictive control)."""

    @property
    def target(self) -> Literal["set-point", "reference"] | None:
        """What the outputs are to follow; None: a law that is not linear has a set-point of its own."""
        if self.reference is not None:
            return "reference"
        return "set-point" if self.is_linear or self.setpoint is not None else None

    @property
    def states(self) -> int:
        """Number of the controller's own states, which belong to the model."""
        return 0

    @abstractmethod
    def law(self, model: ControlModel) -> ControlLaw:
        """Return the control law.

        Raises:
            CallerError: the law cannot be created.
        """

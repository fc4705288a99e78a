"""Settings of the event-triggering policies; :mod:`noack.trigger` has the policies themselves."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, FiniteFloat, Tag, model_validator

from noack.core.clock import NS_PER_S
from noack.settings.matrices import Rows, require_shape
from noack.settings.section import Positive, ScenarioSection

NonNegative = Annotated[FiniteFloat, Field(ge=0)]
Size = Annotated[FiniteFloat, Field(ge=1e-15, le=1e15)]
Share = Annotated[FiniteFloat, Field(gt=0, le=1e9)]
Interval = Annotated[FiniteFloat, Field(ge=1e-9, le=1e7)]


class _Weighted(ScenarioSection):
    weight: Rows | None = None
    """W of the norm ‖v‖_W = ‖W v‖₂ by rows, n x n, invertible; the identity unless given."""

    def check(self, n: int, why: str) -> None:
        """Require matrices of the right shapes for n states.

        Raises:
            ValueError: one is not.
        """
        require_shape(self.weight, "trigger.weight", (n, n), why)
        if self.weight is not None and np.linalg.matrix_rank(np.array(self.weight)) < n:
            raise ValueError("trigger.weight: W must be invertible, this one is singular")


class DecayingSettings(_Weighted):
    """The paper's trigger: transmit when ‖e_s‖_W > max(β e^{−αt}, floor)."""

    policy: Literal["decaying"] = "decaying"
    """The event-triggering policy."""
    beta: Positive
    """β, in the units of ‖W x‖."""
    alpha_per_s: Positive
    """α, per second."""
    floor: NonNegative = 0.0
    """ε: the threshold never falls below it (practical stability); 0 is the paper's rule."""


class AbsoluteSettings(_Weighted):
    """Send-on-delta: transmit when ‖e_s‖_W > δ."""

    policy: Literal["absolute"]
    """The event-triggering policy."""
    delta: Size
    """δ, in the units of ‖W x‖."""


class RelativeSettings(_Weighted):
    """Transmit when ‖e_s‖_W > σ‖x‖_W (Tabuada 2007)."""

    policy: Literal["relative"]
    """The event-triggering policy."""
    sigma: Share
    """σ."""


class MixedSettings(_Weighted):
    """Transmit when ‖e_s‖_W² > σ²‖x‖_W² + ε²."""

    policy: Literal["mixed"]
    """The event-triggering policy."""
    sigma: Share
    """σ."""
    epsilon: Size
    """ε, in the units of ‖W x‖."""


class QuadraticSettings(_Weighted):
    """Periodic event-triggered control: at sampling times, transmit when zᵀQz > ε, z = (x, e_s)."""

    policy: Literal["quadratic"]
    """The event-triggering policy."""
    Q: Rows
    """Q by rows, 2n x 2n, symmetric."""
    epsilon: NonNegative = 0.0
    """ε."""
    period_s: Interval
    """Sampling period; a whole number of the time between measurements."""
    heartbeat: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Transmit after so many periods at the latest; 0: only when the rule says so."""

    def check(self, n: int, why: str) -> None:
        """Require matrices of the right shapes, and a symmetric Q."""
        super().check(n, why)
        require_shape(self.Q, "trigger.Q", (2 * n, 2 * n), f"{why}, and z = (x, e_s)")
        Q = np.array(self.Q)
        if not np.allclose(Q, Q.T, rtol=1e-12, atol=0.0):
            raise ValueError("trigger.Q: must be symmetric")


class _WithLyapunov(_Weighted):
    Q: Rows | None = None
    """Q by rows, n x n, symmetric and positive definite; the identity unless given. P solves
    AᵀP + PA = −Q of the closed loop A = Â + B̂K."""

    def check(self, n: int, why: str) -> None:
        """Require matrices of the right shapes, and a positive definite Q."""
        super().check(n, why)
        require_shape(self.Q, "trigger.Q", (n, n), why)
        if self.Q is not None:
            Q = np.array(self.Q)
            if not np.allclose(Q, Q.T, rtol=1e-12, atol=0.0) or np.linalg.eigvalsh(Q)[0] <= 0:
                raise ValueError("trigger.Q: must be symmetric and positive definite")


class LyapunovSettings(_WithLyapunov):
    """Transmit when V(x) = xᵀPx > V(x(t_k)) e^{−ρ(t−t_k)}, t_k the last event."""

    policy: Literal["lyapunov"]
    """The event-triggering policy."""
    rate_per_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)]
    """ρ."""


class DynamicSettings(_WithLyapunov):
    """Transmit when η + θw ≤ 0, η̇ = −λη + w, w = σxᵀQx − 2xᵀPBKe_s (Girard 2015)."""

    policy: Literal["dynamic"]
    """The event-triggering policy."""
    sigma: Annotated[FiniteFloat, Field(gt=0, lt=1)]
    """σ."""
    theta_s: Annotated[FiniteFloat, Field(gt=0, le=1e9)]
    """θ, in seconds."""
    decay_per_s: Annotated[FiniteFloat, Field(ge=0, le=1e4)]
    """λ. What is saved is forgotten within 1/λ, which exact simulation must follow."""
    eta_0: Annotated[FiniteFloat, Field(ge=0, le=1e15)] = 0.0
    """η at the start."""


class PeriodicSettings(_Weighted):
    """Time-triggered: transmit every period."""

    policy: Literal["periodic"]
    """The event-triggering policy."""
    period_s: Interval
    """Period."""


class SelfTriggeredSettings(_Weighted):
    """At each event the sensor decides when the next one is.

    It is when ‖e_s‖_W could reach the paper's threshold, given
    d‖e_s‖_W/dt ≤ L‖e_s‖_W + a‖x(t_k)‖_W + b.
    """

    policy: Literal["self_triggered"]
    """The event-triggering policy."""
    beta: Positive
    """β, in the units of ‖W x‖."""
    alpha_per_s: Positive
    """α, per second."""
    floor: NonNegative = 0.0
    """ε."""
    growth_per_s: NonNegative
    """L."""
    mismatch_per_s: NonNegative
    """a."""
    disturbance_per_s: NonNegative = 0.0
    """b, in the units of ‖W x‖ per second."""
    shortest_s: Interval
    """The next event is not earlier."""
    longest_s: Interval
    """It is not later."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.longest_s < self.shortest_s:
            raise ValueError("longest_s: must not be less than shortest_s")
        return self


class _Combined(ScenarioSection):
    rule: "AnyTrigger"
    """The rule that is combined."""
    interval_s: Interval
    """How long after the last event."""

    @property
    def weight(self) -> Rows | None:
        """That of the rule."""
        return self.rule.weight

    def check(self, n: int, why: str) -> None:
        """Require that the rule fits n states."""
        try:
            self.rule.check(n, why)
        except ValueError as error:
            raise ValueError(str(error).replace("trigger.", "trigger.rule.", 1)) from None


class DeadlineSettings(_Combined):
    """Any rule, and at the latest so long after the last event."""

    policy: Literal["deadline"]
    """The event-triggering policy."""


class DwellSettings(_Combined):
    """Any rule, but not earlier than so long after the last event."""

    policy: Literal["dwell"]
    """The event-triggering policy."""


def _policy(given: object) -> object:
    """The policy of a table; one that names none has the paper's."""
    if isinstance(given, dict):
        return given.get("policy", "decaying")
    return getattr(given, "policy", None)


AnyTrigger = Annotated[
    Annotated[DecayingSettings, Tag("decaying")]
    | Annotated[AbsoluteSettings, Tag("absolute")]
    | Annotated[RelativeSettings, Tag("relative")]
    | Annotated[MixedSettings, Tag("mixed")]
    | Annotated[QuadraticSettings, Tag("quadratic")]
    | Annotated[LyapunovSettings, Tag("lyapunov")]
    | Annotated[DynamicSettings, Tag("dynamic")]
    | Annotated[PeriodicSettings, Tag("periodic")]
    | Annotated[SelfTriggeredSettings, Tag("self_triggered")]
    | Annotated[DeadlineSettings, Tag("deadline")]
    | Annotated[DwellSettings, Tag("dwell")],
    Discriminator(_policy),
]

for _combined in (_Combined, DeadlineSettings, DwellSettings):
    _combined.model_rebuild()


def require_on_grid(trigger: AnyTrigger, measured_ns: int, key: str = "trigger") -> None:
    """Require that a trigger with a sampling period of its own looks when something is measured.

    Args:
        trigger: the trigger.
        measured_ns: time between measurements.
        key: of the trigger.

    Raises:
        ValueError: it does not.
    """
    if isinstance(trigger, DeadlineSettings | DwellSettings):
        require_on_grid(trigger.rule, measured_ns, f"{key}.rule")
    elif (
        isinstance(trigger, QuadraticSettings) and round(trigger.period_s * NS_PER_S) % measured_ns
    ):
        raise ValueError(
            f"{key}.period_s: must be a whole number of the {measured_ns / NS_PER_S} s "
            "between measurements"
        )

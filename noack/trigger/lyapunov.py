"""Transmit when V(x) = xᵀPx exceeds an envelope that decays from the last event on.

    V(x(t)) > V(x(t_k)) e^{−ρ(t−t_k)}

(Mazo, Anta, Tabuada: Automatica 46(8), 2010, as a self-triggered rule.) Just after an event V lies
on its envelope. If the update arrives and ρ is less than the decay rate of V under the continuous
control, V falls below the envelope. If the update was lost, V may stay above, and the next test is
an event again. So no minimum inter-event time is known under losses: the rule needs sampling, or a
dwell time.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat

from noack.core.linear_systems import Matrix
from noack.trigger.policy_settings import LyapunovFunctionSettings, ModelMatrices
from noack.trigger.trigger_rule import QuadraticForm, TriggerRule, empty_map, state_map


class LyapunovSettings(LyapunovFunctionSettings):
    """Transmit when V(x) = xᵀPx > V(x(t_k)) e^{−ρ(t−t_k)}, t_k the last event."""

    events_may_accumulate: ClassVar = True

    policy: Literal["lyapunov"]
    rate_per_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)]
    """ρ."""

    @classmethod
    def example(cls, n: int) -> Self:
        return cls(policy="lyapunov", rate_per_s=0.3)

    def trigger_policy(self, model: ModelMatrices) -> "LyapunovTrigger":
        P, _ = self.lyapunov_function(model)
        factor = np.ascontiguousarray(np.linalg.cholesky(P).T)
        return LyapunovTrigger(factor, self.rate_per_s, self.weight_matrix)

    @property
    def description(self) -> str:
        return f"V(x) > V(x(t_k)) e^(−{self.rate_per_s:g} (t−t_k))"


@dataclass(frozen=True)
class LyapunovTrigger:
    """The envelope rule; ``factor`` is L with P = LᵀL, shape (n, n), and ρ > 0."""

    factor: Matrix
    rate_per_s: float
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        form = QuadraticForm(state_map(n, self.factor), empty_map(n))
        return TriggerRule(form, rate_per_s=self.rate_per_s / 2, from_event=True)

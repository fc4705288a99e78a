"""Transmit when V(x) = xᵀPx exceeds an envelope that decays from the last event on.

    V(x(t)) > V(x(t_k)) e^{−ρ(t−t_k)}

(Mazo, Anta, Tabuada: Automatica 46(8), 2010, as a self-triggered rule.) Just after an event V lies
on its envelope. If the update arrives and ρ is less than the decay rate of V under the continuous
control, V falls below the envelope. If the update was lost, V may stay above, and the next test is
an event again. So no minimum inter-event time is known under losses: the rule needs sampling, or a
dwell time.
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from noack.trigger_policies.policy_settings import LyapunovFunctionSettings, ModelMatrices
from noack.trigger_policies.trigger_rule import QuadraticForm, TriggerRule, empty_map, state_map


class LyapunovSettings(LyapunovFunctionSettings):
    """Transmit when V(x) = xᵀPx > V(x(t_k)) e^{−ρ(t−t_k)}, t_k the last event."""

    example_keys: ClassVar = {"rate_per_s": 0.3}

    policy: Literal["lyapunov"]
    rate_per_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)]
    """ρ."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        P, _ = self.lyapunov_function(model)
        factor = np.ascontiguousarray(np.linalg.cholesky(P).T)  # V(x) = ‖L x‖²
        form = QuadraticForm(state_map(len(P), factor), empty_map(len(P)))
        return TriggerRule(form, rate_per_s=self.rate_per_s / 2, from_event=True, weight=self.weight_matrix)

    @property
    def description(self) -> str:
        return f"V(x) > V(x(t_k)) e^(−{self.rate_per_s:g} (t−t_k))"

"""Dynamic triggering: a margin that the relative rule leaves unused postpones later events.

    η̇ = −λη + w,   w = σ xᵀQx − 2 xᵀPBK e_s,   transmit when η + θw ≤ 0

with AᵀP+PA = −Q of the closed loop A = Â+B̂K (Girard, IEEE TAC 60(7), 2015). θ = 0 transmits when
η reaches 0; θ → ∞ is the static rule w < 0, which ensures V̇ ≤ −(1−σ) xᵀQx where every update
arrives. From the same state on, events are never earlier than those of the static rule. When
updates are lost, the same holds as for the relative rule.
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from noack.trigger_policies.policy_settings import LyapunovFunctionSettings, ModelMatrices
from noack.trigger_policies.trigger_rule import DynamicVariable, TriggerRule, quadratic_form


class DynamicSettings(LyapunovFunctionSettings):
    """Transmit when η + θw ≤ 0, η̇ = −λη + w, w = σxᵀQx − 2xᵀPBKe_s (Girard 2015)."""

    at_start_only: ClassVar = ("eta_0",)

    example_keys: ClassVar = {"sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5, "eta_0": 1.0}

    policy: Literal["dynamic"]
    sigma: Annotated[FiniteFloat, Field(gt=0, lt=1)]
    """σ."""
    theta_s: Annotated[FiniteFloat, Field(gt=0, le=1e9)]
    """θ, in seconds."""
    decay_per_s: Annotated[FiniteFloat, Field(ge=0, le=1e4)]
    """λ. η decays with the time constant 1/λ, which exact simulation must resolve."""
    eta_0: Annotated[FiniteFloat, Field(ge=0, le=1e15)] = 0.0
    """η at the start."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        P, Q = self.lyapunov_function(model)
        n, cross = len(P), P @ (model.B @ model.K)
        w = np.zeros((2 * n, 2 * n))
        w[:n, :n] = self.sigma * Q
        w[:n, n:] = -cross
        w[n:, :n] = -cross.T
        # Events do not reset η.
        eta = DynamicVariable(self.decay_per_s, quadratic_form(w), self.eta_0)
        compared = quadratic_form(-self.theta_s * w)
        return TriggerRule(compared, dynamic_variable=eta, weight=self.weight_matrix)

    @property
    def description(self) -> str:
        return (
            f"η + {self.theta_s:g} w ≤ 0, dη/dt = −{self.decay_per_s:g} η + w, "
            f"w = {self.sigma:g} xᵀQx − 2 xᵀPBK e_s"
        )

"""The paper's trigger: transmit when the sensor error exceeds a decaying threshold (eq:thre).

    t_{i+1} = min { t > t_i : ‖e_s(t)‖_W > max(β e^{−αt}, ε) },   e_s = x_s − x

with ‖v‖_W = ‖W v‖₂ and t counted from the run's start. W = I and ε = 0 is the paper's rule. Its
minimum inter-event time is positive by Theorem 2 for 0 < α < ᾱ; with ε > 0 stability is practical.
"""

from typing import ClassVar, Literal

from netem.core.settings_section import NonNegative, Positive
from noack.trigger_policies.policy_settings import ModelMatrices, WeightedSettings
from noack.trigger_policies.trigger_rule import TriggerRule, error_form


class DecayingSettings(WeightedSettings):
    """The paper's trigger: transmit when ‖e_s‖_W > max(β e^{−αt}, floor)."""

    example_keys: ClassVar = {"beta": 0.5, "alpha_per_s": 0.25}

    policy: Literal["decaying"] = "decaying"
    beta: Positive
    """β, in the units of ‖W x‖."""
    alpha_per_s: Positive
    """α, per second."""
    floor: NonNegative = 0.0
    """ε: the threshold never falls below it (practical stability); 0 is the paper's rule."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        W = self.weight_matrix
        form = error_form(len(model.A), W)
        return TriggerRule(form, self.beta, self.alpha_per_s, self.floor, weight=W)

    @property
    def description(self) -> str:
        return f"‖e_s‖ > {decaying_text(self.beta, self.alpha_per_s, self.floor)}"


def decaying_text(beta: float, alpha_per_s: float, floor: float) -> str:
    """Return max(β e^{−αt}, ε) with its numbers."""
    decay = f"{beta:g} e^(−{alpha_per_s:g} t)"
    return f"max({decay}, {floor:g})" if floor else decay

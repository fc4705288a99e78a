"""The relative rule: transmit when ‖e_s‖_W > σ‖x‖_W (Tabuada, IEEE TAC 52(9), 2007).

The mixed rule without its constant; see :mod:`noack.trigger_policies.mixed`.
"""

from typing import ClassVar, Literal

from noack.trigger_policies.mixed import mixed_rule
from noack.trigger_policies.policy_settings import ModelMatrices, Ratio, WeightedSettings
from noack.trigger_policies.trigger_rule import TriggerRule


class RelativeSettings(WeightedSettings):
    """Transmit when ‖e_s‖_W > σ‖x‖_W (Tabuada 2007)."""

    example_keys: ClassVar = {"sigma": 0.2}

    policy: Literal["relative"]
    sigma: Ratio
    """σ."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        return mixed_rule(len(model.A), self.sigma, 0.0, self.weight_matrix)

    @property
    def description(self) -> str:
        return f"‖e_s‖ > {self.sigma:g} ‖x‖"

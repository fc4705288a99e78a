"""Send-on-delta: transmit when the sensor error exceeds a constant, ‖e_s‖_W > δ.

Stability is practical: the state ends in a neighbourhood of 0 of the size of δ. The minimum
inter-event time is positive for bounded states, as e_s grows from 0 at a bounded rate.
"""

from typing import ClassVar, Literal

from noack.trigger_policies.policy_settings import ModelMatrices, Size, WeightedSettings
from noack.trigger_policies.trigger_rule import TriggerRule, error_form


class AbsoluteSettings(WeightedSettings):
    """Send-on-delta: transmit when ‖e_s‖_W > δ."""

    example_keys: ClassVar = {"delta": 0.05}

    policy: Literal["absolute"]
    delta: Size
    """δ, in the units of ‖W x‖."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        form = error_form(len(model.A), self.weight_matrix)
        return TriggerRule(form, floor=self.delta, weight=self.weight_matrix)

    @property
    def description(self) -> str:
        return f"‖e_s‖ > {self.delta:g}"

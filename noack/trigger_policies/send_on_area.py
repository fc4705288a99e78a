"""Send-on-area: transmit when the integral of the sensor error since the last event exceeds δ.

    ∫_{t_k}^{t} ‖e_s(τ)‖_W dτ > δ

(Miskowicz, "Efficiency of Event-Based Sampling According to Error Energy Criterion", Sensors 10(3),
2010, and his earlier integral criterion.) A small error that lasts is transmitted as well as a
large one. Stability is practical. The minimum inter-event time is positive for bounded states, as
e_s grows from 0 at a bounded rate. A live sensor integrates by the trapezoidal rule between
measurements; exact simulation integrates e_s itself.
"""

from typing import ClassVar, Literal

from noack.trigger_policies.policy_settings import ModelMatrices, Size, WeightedSettings
from noack.trigger_policies.trigger_rule import TriggerRule, error_form


class SendOnAreaSettings(WeightedSettings):
    """Transmit when ∫‖e_s‖_W dt since the last event exceeds δ (Miskowicz)."""

    example_keys: ClassVar = {"delta_s": 0.02}

    policy: Literal["send_on_area"]
    delta_s: Size
    """δ, in the units of ‖W x‖ times seconds."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        form = error_form(len(model.A), self.weight_matrix)
        return TriggerRule(form, floor=self.delta_s, integrates=True, weight=self.weight_matrix)

    @property
    def description(self) -> str:
        return f"∫‖e_s‖ dt since the last event > {self.delta_s:g}"

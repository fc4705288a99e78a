"""Time-triggered control: transmit every period, independently of the measurements."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from netem.core.periods import whole_ns
from noack.trigger_policies.policy_settings import IntervalS, ModelMatrices, WeightedSettings
from noack.trigger_policies.trigger_rule import TriggerRule, no_form


class PeriodicSettings(WeightedSettings):
    """Time-triggered: transmit every period."""

    example_keys: ClassVar = {"period_s": 1.0}

    policy: Literal["periodic"]
    period_s: IntervalS
    """Period."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        period_ns = whole_ns(self.period_s)
        return TriggerRule(no_form(len(model.A)), longest_ns=period_ns, weight=self.weight_matrix)

    def intervals(self) -> Mapping[str, tuple[str, float]]:
        return {"period_s": ("updates are sent at measurements, every", self.period_s)}

    @property
    def description(self) -> str:
        return f"every {self.period_s:g} s"

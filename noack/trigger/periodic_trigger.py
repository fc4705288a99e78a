"""Time-triggered control: transmit every period, independently of the measurements."""

from dataclasses import dataclass
from typing import Literal, Self

from noack.core.linear_systems import Matrix
from noack.trigger.policy_settings import Interval, ModelMatrices, WeightedSettings, nanoseconds
from noack.trigger.trigger_rule import QuadraticForm, TriggerRule, empty_map


class PeriodicSettings(WeightedSettings):
    """Time-triggered: transmit every period."""

    policy: Literal["periodic"]
    period_s: Interval
    """Period."""

    @classmethod
    def example(cls, n: int) -> Self:
        return cls(policy="periodic", period_s=1.0)

    def trigger_policy(self, model: ModelMatrices) -> "PeriodicTrigger":
        return PeriodicTrigger(nanoseconds(self.period_s), self.weight_matrix)

    @property
    def description(self) -> str:
        return f"every {self.period_s:g} s"


@dataclass(frozen=True)
class PeriodicTrigger:
    """The periodic rule."""

    period_ns: int
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        return TriggerRule(QuadraticForm(empty_map(n), empty_map(n)), longest_ns=self.period_ns)

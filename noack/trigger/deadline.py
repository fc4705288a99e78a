"""Any rule with a deadline: transmit at the latest T_max after the last event.

This is the combined rule of Garcia & Antsaklis's earlier work (the paper's reference Garcia16iet):
if the controller receives nothing for T_max, an update was lost. The rule's error bound holds.
"""

from typing import Literal, Self

from noack.trigger.combined import CombinedSettings, CombinedTrigger
from noack.trigger.mixed import MixedSettings
from noack.trigger.policy_settings import ModelMatrices, nanoseconds
from noack.trigger.trigger_rule import TriggerRule


class DeadlineSettings(CombinedSettings):
    """Any rule with a deadline: an event at the latest ``interval_s`` after the last one."""

    policy: Literal["deadline"]

    @classmethod
    def example(cls, n: int) -> Self:
        return cls(policy="deadline", rule=MixedSettings.example(n), interval_s=1.0)

    def trigger_policy(self, model: ModelMatrices) -> "DeadlineTrigger":
        return DeadlineTrigger(self.rule.trigger_policy(model), nanoseconds(self.interval_s))

    @property
    def description(self) -> str:
        return f"{self.rule.description}, or {self.interval_s:g} s after the last event"


class DeadlineTrigger(CombinedTrigger):
    """A rule with a deadline."""

    def trigger_rule(self, n: int) -> TriggerRule:
        rule = self.rule.trigger_rule(n)
        return rule._replace(
            longest_ns=min(rule.longest_ns, self.interval_ns),
            shortest_ns=min(rule.shortest_ns, self.interval_ns),
        )

"""Any rule with a deadline: transmit at the latest T_max after the last event.

This is the combined rule of Garcia & Antsaklis's earlier work (the paper's reference Garcia16iet):
if the controller receives nothing for T_max, an update was lost. The rule's error bound holds.
"""

from typing import ClassVar, Literal

from noack.trigger_policies.policy_settings import CombinedSettings
from noack.trigger_policies.trigger_rule import TriggerRule


class DeadlineSettings(CombinedSettings):
    """Any rule with a deadline: an event at the latest ``interval_s`` after the last one."""

    example_keys: ClassVar = {
        "interval_s": 1.0,
        "rule": {"policy": "mixed", "sigma": 0.1, "epsilon": 0.05},
    }

    policy: Literal["deadline"]

    def combined(self, rule: TriggerRule, interval_ns: int) -> TriggerRule:
        return rule._replace(
            longest_ns=min(rule.longest_ns, interval_ns),
            shortest_ns=min(rule.shortest_ns, interval_ns),
        )

    @property
    def description(self) -> str:
        return f"{self.rule.description}, or {self.interval_s:g} s after the last event"

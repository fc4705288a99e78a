"""Any rule, but not earlier than τ_min after the last event (time regularisation).

The minimum inter-event time is τ_min by construction. Until then, the quantity that the rule
compares may exceed the threshold.
"""

from typing import ClassVar, Literal

from noack.trigger_policies.policy_settings import CombinedSettings
from noack.trigger_policies.trigger_rule import TriggerRule


class DwellSettings(CombinedSettings):
    """Any rule, but no event earlier than ``interval_s`` after the last one."""

    example_keys: ClassVar = {"interval_s": 0.1, "rule": {"policy": "lyapunov", "rate_per_s": 0.3}}

    policy: Literal["dwell"]

    def combined(self, rule: TriggerRule, interval_ns: int) -> TriggerRule:
        # An event that is due before happens at the end of the dwell time.
        return rule._replace(
            idle_ns=max(rule.idle_ns, interval_ns),
            longest_ns=max(rule.longest_ns, interval_ns),
            shortest_ns=max(rule.shortest_ns, interval_ns),
        )

    @property
    def description(self) -> str:
        return f"{self.rule.description}, not within {self.interval_s:g} s of the last event"

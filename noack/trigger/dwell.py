"""Any rule, but not earlier than τ_min after the last event (time regularisation).

The minimum inter-event time is τ_min by construction. Until then, the quantity that the rule
compares may exceed the threshold.
"""

from typing import Literal, Self

from noack.trigger.combined import CombinedSettings
from noack.trigger.lyapunov import LyapunovSettings
from noack.trigger.trigger_rule import TriggerRule


class DwellSettings(CombinedSettings):
    """Any rule, but no event earlier than ``interval_s`` after the last one."""

    policy: Literal["dwell"]

    @classmethod
    def example(cls, n: int) -> Self:
        return cls(policy="dwell", rule=LyapunovSettings.example(n), interval_s=0.1)

    def combined(self, rule: TriggerRule, interval_ns: int) -> TriggerRule:
        return with_dwell_time(rule, interval_ns)

    @property
    def description(self) -> str:
        return f"{self.rule.description}, not within {self.interval_s:g} s of the last event"


def with_dwell_time(rule: TriggerRule, interval_ns: int) -> TriggerRule:
    """Return a rule after the dwell time; an event that is due before happens at its end."""
    return rule._replace(
        idle_ns=max(rule.idle_ns, interval_ns),
        longest_ns=max(rule.longest_ns, interval_ns),
        shortest_ns=max(rule.shortest_ns, interval_ns),
    )

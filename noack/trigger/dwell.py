"""Any rule, but not earlier than τ_min after the last event (time regularisation).

The minimum inter-event time is τ_min by construction. What the rule would have kept below its
threshold may exceed it for as long.
"""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_policy import Policy
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class DwellTrigger:
    """A rule with a dwell time."""

    rule: Policy
    interval_ns: int

    @property
    def weight(self) -> Matrix | None:
        """That of the rule."""
        return self.rule.weight

    @property
    def initial_dynamic_variable(self) -> float:
        """That of the rule."""
        return self.rule.initial_dynamic_variable

    def trigger_rule(self, n: int) -> TriggerRule:
        """The rule's, after the dwell time; what is due before then is due at its end."""
        rule = self.rule.trigger_rule(n)
        return rule._replace(
            idle_ns=max(rule.idle_ns, self.interval_ns),
            longest_ns=max(rule.longest_ns, self.interval_ns),
            shortest_ns=max(rule.shortest_ns, self.interval_ns),
        )

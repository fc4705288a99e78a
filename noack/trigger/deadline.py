"""Any rule, or a deadline: transmit at the latest T_max after the last event.

The combined rule of Garcia & Antsaklis's earlier work (the paper's reference Garcia16iet): silence
then tells the controller something. What the rule keeps below its threshold stays there.
"""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_policy import Policy
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class DeadlineTrigger:
    """A rule with a deadline."""

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
        """The rule's, and the deadline."""
        rule = self.rule.trigger_rule(n)
        return rule._replace(
            longest_ns=min(rule.longest_ns, self.interval_ns),
            shortest_ns=min(rule.shortest_ns, self.interval_ns),
        )

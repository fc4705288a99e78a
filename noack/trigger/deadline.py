"""Any rule, or a deadline: transmit at the latest T_max after the last event.

The combined rule of Garcia & Antsaklis's earlier work (the paper's reference Garcia16iet): silence
then tells the controller something. What the rule keeps below its threshold stays there.
"""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_policy import Policy
from noack.trigger.trigger_rule import Guards


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
    def first_reserve(self) -> float:
        """That of the rule."""
        return self.rule.first_reserve

    def guards(self, n: int) -> Guards:
        """The rule's, and the deadline."""
        guards = self.rule.guards(n)
        return guards._replace(
            longest_ns=min(guards.longest_ns, self.interval_ns),
            shortest_ns=min(guards.shortest_ns, self.interval_ns),
        )

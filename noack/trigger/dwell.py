"""Any rule, but not earlier than τ_min after the last event (time regularisation).

The minimum inter-event time is τ_min by construction. What the rule would have kept below its
threshold may exceed it for as long.
"""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_policy import Policy
from noack.trigger.trigger_rule import Guards


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
    def first_reserve(self) -> float:
        """That of the rule."""
        return self.rule.first_reserve

    def guards(self, n: int) -> Guards:
        """The rule's, after the dwell time; what is due before then is due at its end."""
        guards = self.rule.guards(n)
        return guards._replace(
            idle_ns=max(guards.idle_ns, self.interval_ns),
            longest_ns=max(guards.longest_ns, self.interval_ns),
            shortest_ns=max(guards.shortest_ns, self.interval_ns),
        )

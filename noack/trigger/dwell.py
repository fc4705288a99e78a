"""Any rule, but not earlier than τ_min after the last event (time regularisation).

The minimum inter-event time is τ_min by construction. What the rule would have kept below its
threshold may exceed it for as long.
"""

from dataclasses import dataclass

from noack.linear import Matrix, Vector
from noack.trigger.guard import Guard
from noack.trigger.policy import Policy


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

    def guard(self, t_ns: float, x: Vector) -> Guard:
        """The rule's, after the dwell time; what is due before then is due at its end."""
        guard, end_ns = self.rule.guard(t_ns, x), t_ns + self.interval_ns
        return guard._replace(
            earliest_ns=max(guard.earliest_ns, end_ns), latest_ns=max(guard.latest_ns, end_ns)
        )

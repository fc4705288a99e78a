"""Any rule, or a deadline: transmit at the latest T_max after the last event.

The combined rule of Garcia & Antsaklis's earlier work (the paper's reference Garcia16iet): silence
then tells the controller something. What the rule keeps below its threshold stays there.
"""

from dataclasses import dataclass

from noack.linear import Matrix, Vector
from noack.trigger.guard import Guard
from noack.trigger.policy import Policy


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

    def guard(self, t_ns: float, x: Vector) -> Guard:
        """The rule's, and the deadline."""
        guard = self.rule.guard(t_ns, x)
        return guard._replace(latest_ns=min(guard.latest_ns, t_ns + self.interval_ns))

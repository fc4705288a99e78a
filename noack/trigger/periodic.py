"""Time-triggered control: transmit every period, whatever is measured."""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_condition import Form, nothing
from noack.trigger.trigger_rule import Guards


@dataclass(frozen=True)
class PeriodicTrigger:
    """The periodic rule."""

    period_ns: int
    weight: Matrix | None = None
    first_reserve = 0.0

    def guards(self, n: int) -> Guards:
        """A period after the event."""
        return Guards(Form(nothing(n), nothing(n)), longest_ns=self.period_ns)

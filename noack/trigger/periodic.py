"""Time-triggered control: transmit every period, whatever is measured."""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_condition import QuadraticForm, empty_map
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class PeriodicTrigger:
    """The periodic rule."""

    period_ns: int
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        """A period after the event."""
        return TriggerRule(QuadraticForm(empty_map(n), empty_map(n)), longest_ns=self.period_ns)

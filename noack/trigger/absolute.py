"""Send-on-delta: transmit when the sensor error exceeds a constant, ‖e_s‖_W > δ.

Stability is practical: the state ends in a neighbourhood of 0 of the size of δ. The minimum
inter-event time is positive for bounded states, as e_s grows from 0 at a bounded rate.
"""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_condition import Form, nothing, of_error
from noack.trigger.trigger_rule import Guards


@dataclass(frozen=True)
class AbsoluteTrigger:
    """Send-on-delta; δ > 0 in the units of ‖W x‖."""

    delta: float
    weight: Matrix | None = None
    first_reserve = 0.0

    def guards(self, n: int) -> Guards:
        """The same after every event."""
        return Guards(Form(of_error(n, self.weight), nothing(n)), floor=self.delta)

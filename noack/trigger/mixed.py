"""Transmit when the sensor error is large beside the state: ‖e_s‖_W² > σ²‖x‖_W² + ε².

ε = 0 is the relative rule (Tabuada, IEEE TAC 52(9), 2007): where every update arrives, and σ is
small enough, the loop is asymptotically stable and the minimum inter-event time positive. When
updates are lost e_c no longer follows e_s, and the state's smallness no longer says that little is
to be sent: near the origin events may accumulate. σ = 0 is send-on-delta. With ε > 0 stability is
practical, and the minimum inter-event time positive for bounded states.
"""

from dataclasses import dataclass

import numpy as np

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_condition import QuadraticForm, error_map, state_map
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class MixedTrigger:
    """The mixed rule; σ > 0 without a unit, ε ≥ 0 in the units of ‖W x‖."""

    sigma: float
    epsilon: float = 0.0
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        """The same after every event."""
        down: Matrix = self.sigma * state_map(n, self.weight)
        return TriggerRule(
            QuadraticForm(error_map(n, self.weight), np.asarray(down)), floor=self.epsilon
        )

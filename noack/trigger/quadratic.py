"""Periodic event-triggered control: at sampling times, transmit when zᵀQz > ε, z = (x, e_s).

(Heemels, Donkers, Teel: IEEE TAC 58(4), 2013.) The minimum inter-event time is the sampling
period by construction. A heartbeat transmits after so many periods without an event.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_condition import NEVER_NS, QuadraticForm, quadratic_form
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class QuadraticTrigger:
    """The quadratic rule on a grid.

    Args:
        Q: symmetric, shape (2n, 2n), on z = (x, e_s).
        period_ns: sampling period.
        epsilon: ε ≥ 0.
        heartbeat: transmit after so many periods at the latest; 0 for none.
        weight: only for showing errors.
    """

    Q: Matrix
    period_ns: int
    epsilon: float = 0.0
    heartbeat: int = 0
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    @cached_property
    def form(self) -> QuadraticForm:
        """Q as a difference of squares."""
        return quadratic_form(self.Q)

    def trigger_rule(self, n: int) -> TriggerRule:
        """On the grid, later than the event."""
        return TriggerRule(
            self.form, floor=float(np.sqrt(self.epsilon)), grid_ns=self.period_ns,
            longest_ns=self.heartbeat * self.period_ns if self.heartbeat else NEVER_NS,
        )  # fmt: skip

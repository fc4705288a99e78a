"""A policy's trigger rule, as data: from each event it makes the condition of the next one.

The live sensor and exact simulation both read this one description.
"""

import math
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, norm
from noack.core.ordered_arithmetic import product
from noack.trigger.self_triggered_interval import Forecast, interval_ns
from noack.trigger.trigger_condition import (
    NEVER_NS,
    DynamicVariable,
    QuadraticForm,
    TriggerCondition,
)


class TriggerRule(NamedTuple):
    """How each event sets the condition of the next one; names as in ``TriggerCondition``."""

    form: QuadraticForm
    level: float = 0.0
    """c ≥ 0; it decays from t₀ = 0 on."""
    rate_per_s: float = 0.0
    """ρ ≥ 0."""
    floor: float = 0.0
    """f ≥ 0."""
    from_event: bool = False
    """Instead, t₀ is the event's time, and c is ‖P z‖ just after it."""
    grid_ns: float = 0.0
    dynamic_variable: DynamicVariable | None = None
    integrates: bool = False
    idle_ns: float = -math.inf
    """The comparison does not count before this time after an event."""
    longest_ns: float = NEVER_NS
    """The next event is due this time after an event; with a forecast, at the latest."""
    shortest_ns: float = 0.0
    """With a forecast: the next event is not due before this time after an event."""
    forecast: Forecast | None = None
    weight: Matrix | None = None
    """W of the ‖x‖_W that the forecast begins with, (n, n); None is the identity."""

    @property
    def fading_per_s(self) -> float:
        """α of a threshold that decays from the run's start on; 0 for other thresholds."""
        return 0.0 if self.from_event else self.rate_per_s

    def after(self, t_ns: float, x: Vector) -> TriggerCondition:
        """The condition after an event at a state x, (n,), or from the start on."""
        level, since_ns, due_ns = self.level, 0.0, self.longest_ns
        if self.from_event:
            # The same bits as the compared norm, so that the event itself does not exceed it.
            z = np.concatenate([x, np.zeros_like(x)])
            level, since_ns = norm(product(self.form.up, z)), t_ns
        if self.forecast is not None:
            size = norm(x if self.weight is None else product(self.weight, x))
            due_ns = interval_ns(
                self.forecast, size, t_ns * 1e-9, self.shortest_ns, self.longest_ns
            )
        return TriggerCondition(
            self.form, level, self.rate_per_s, since_ns, self.floor,
            t_ns + self.idle_ns, t_ns + due_ns, self.grid_ns, self.dynamic_variable,
            self.integrates,
        )  # fmt: skip

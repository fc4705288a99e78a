"""What can be said of ‖e_c‖ along a run, from what the sensor saw and the controller received.

By (I1), e_c = e_s + Σ e^{H(t−t_k)} e_s(t_k⁻) over the missing events. Two bounds follow:

* the identity's: ‖e_s‖ + Σ ‖e^{H(t−t_k)} e_s(t_k⁻)‖, for every plant, trigger and network;
* the paper's eq:LossEv3: βe^{−αt} + Σ βe^{−αt_k} ‖e^{H(t−t_k)}‖, for a trigger that watches always.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noack.linear import Matrix, Vector
from noack.theory.identities import MissedJumps
from noack.trigger.decaying import DecayingTrigger


class ErrorBounds(NamedTuple):
    """Bounds of ‖e_c‖_W at one time."""

    identity: float
    printed: float


class ErrorMonitor:
    """Follows a run, measurement by measurement.

    Args:
        H: what both models integrate between updates, (n, n), per second.
        trigger: the event-triggering policy.
    """

    def __init__(self, H: Matrix, trigger: DecayingTrigger) -> None:
        self.missed = MissedJumps(H)
        self._trigger = trigger
        weight = np.eye(len(H)) if trigger.weight is None else trigger.weight
        inverse = np.linalg.inv(weight)

        @lru_cache(None)
        def growth(age_ns: int) -> float:
            moved = self.missed.propagate.transition(age_ns)
            return float(np.linalg.norm(weight @ moved @ inverse, 2))

        self._growth = growth

    def sample(self, t_ns: int, e_s: Vector, event: int, received: int) -> ErrorBounds:
        """Take a measurement.

        Args:
            t_ns: its time.
            e_s: the sensor's error before any reset, (n,).
            event: sequence number of the event that it caused, negative for none.
            received: sequence number of the newest update that the controller has, negative for
                none.
        """
        self.missed.advance_to(t_ns)
        if event >= 0:
            self.missed.event(event, e_s)
        self.missed.received(received)
        error_norm, threshold = self._trigger.error_norm, self._trigger.threshold
        identity, printed = 0.0 if event >= 0 else error_norm(e_s), threshold(t_ns)
        for then_ns, jump in self.missed.jumps():
            age_ns = t_ns - then_ns
            identity += error_norm(self.missed.propagate(jump, age_ns))
            printed += threshold(then_ns) * self._growth(age_ns)
        return ErrorBounds(identity, printed)

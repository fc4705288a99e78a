"""Bounds of ‖e_c‖ along a run, from the sensor's errors and the controller's updates.

By (I1), e_c = e_s + Σ e^{H(t−t_k)} e_s(t_k⁻) over the missing events. Two bounds follow:

* the identity's: ‖e_s‖ + Σ ‖e^{H(t−t_k)} e_s(t_k⁻)‖, for every plant, trigger and network;
* the paper's eq:LossEv3: βe^{−αt} + Σ βe^{−αt_k} ‖e^{H(t−t_k)}‖, for a continuous trigger.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import (
    Matrix,
    MatrixKey,
    Vector,
    matrix_key,
    matrix_of,
    row_norms,
    transition,
)
from noack.theory.identities import MissedEvents
from noack.trigger.decaying import DecayingTrigger
from noack.trigger.trigger_policy import Policy


class ErrorBounds(NamedTuple):
    """Bounds of ‖e_c‖_W at k measurements, and the right-hand side of (I1) there."""

    identity: Vector
    """(k,)"""
    printed: Vector
    """(k,) the paper's formula; NaN for other triggers than the paper's."""
    missed: Matrix
    """(k, n) x_c − x_s by (I1): the sum of the missed jumps."""


class ErrorMonitor:
    """Computes the bounds along a run; its measurements lie on a grid of ``period_ns``.

    H is the matrix of both models between updates. The cost is that of a few array operations for
    each pair of a measurement and an event that is missing there.
    """

    def __init__(self, H: Matrix, trigger: Policy, period_ns: int) -> None:
        self._trigger = trigger
        self._missed = MissedEvents(H, period_ns)
        self._weight = np.eye(len(H)) if trigger.weight is None else trigger.weight
        self._growths = _growths(matrix_key(H), matrix_key(self._weight), period_ns)

    def take(
        self,
        t_ns: NDArray[np.int64],
        e_s: Matrix,
        events: NDArray[np.int64],
        received: NDArray[np.int64],
    ) -> ErrorBounds:
        """Add k measurements, as :meth:`noack.theory.identities.MissedEvents.take` does."""
        count = len(t_ns)
        weighted = e_s if self._trigger.weight is None else e_s @ self._weight.T
        identity = np.where(events >= 0, 0.0, row_norms(weighted))
        printed, missed = self._thresholds(t_ns), np.zeros_like(e_s)
        for pairs in self._missed.take(t_ns, e_s, events, received):
            jumps = pairs.jumps if self._trigger.weight is None else pairs.jumps @ self._weight.T
            identity += np.bincount(pairs.at, row_norms(jumps), count)
            missed += pairs.sums(count)
            if isinstance(self._trigger, DecayingTrigger):
                grown = self._growths.at(pairs.periods) * self._thresholds(pairs.event_ns)
                printed += np.bincount(pairs.at, grown, count)
        return ErrorBounds(identity, printed, missed)

    def _thresholds(self, t_ns: NDArray[np.int64]) -> Vector:
        if isinstance(self._trigger, DecayingTrigger):
            return self._trigger.thresholds(t_ns)
        return np.full(len(t_ns), np.nan)


class _Growths:
    """‖e^{Hτ}‖_W at the multiples of a period."""

    def __init__(self, H: Matrix, weight: Matrix, period_ns: int) -> None:
        self._H, self._weight, self._period_ns = H, weight, period_ns
        self._inverse = np.linalg.inv(weight)
        self._known = np.ones(1)

    def at(self, periods: NDArray[np.int64]) -> Vector:
        """Return the values at k multiples, (k,)."""
        known, oldest = len(self._known), int(periods.max(initial=0))
        if oldest >= known:
            ages_ns = (i * self._period_ns for i in range(known, oldest + 1))
            moved = self._weight @ [transition(self._H, ns) for ns in ages_ns] @ self._inverse
            self._known = np.append(self._known, np.linalg.norm(moved, 2, axis=(1, 2)))
        return np.asarray(self._known[periods])


@lru_cache(maxsize=16)
def _growths(H: MatrixKey, weight: MatrixKey, period_ns: int) -> _Growths:
    """Return the growths of some models; loops with equal models share them."""
    return _Growths(matrix_of(H), matrix_of(weight), period_ns)

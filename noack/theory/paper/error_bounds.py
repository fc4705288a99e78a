"""(I1) along a run, and the bounds of ‖e_c‖ that follow from it.

(I1)  x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻)

q is the last event and r the last event whose update the controller received. It extends the
paper's eq:LossEv2 to every loss pattern: x_s jumps by −e_s(t_k⁻) at each event, and x_c misses the
jumps of events r + 1 to q. :class:`MissedEvents` evaluates the right-hand side. Two bounds of
‖e_c‖ follow, which :class:`ErrorMonitor` computes from the sensor's errors and the controller's
updates:

* the identity's: ‖e_s‖ + Σ ‖e^{H(t−t_k)} e_s(t_k⁻)‖, for every plant, trigger and network;
* the paper's eq:LossEv3: βe^{−αt} + Σ βe^{−αt_k} ‖e^{H(t−t_k)}‖, for a continuous trigger.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import (
    Matrix,
    MatrixKey,
    Propagator,
    Vector,
    matrix_key,
    matrix_of,
    row_norms,
    transition,
)
from noack.trigger.trigger_rule import Policy, TriggerRule

_PART_NUMBERS = 2**20
"""Numbers in the jumps that are computed at once."""


class MissedJumps(NamedTuple):
    """Jumps that x_c misses: p pairs of a measurement and an event that is missing there."""

    at: NDArray[np.int64]
    """(p,) place of the measurement."""
    event_ns: NDArray[np.int64]
    """(p,) t_k."""
    periods: NDArray[np.int64]
    """(p,) t − t_k, in periods."""
    jumps: Matrix
    """(p, n) e^{H(t−t_k)} e_s(t_k⁻)."""

    def sums(self, measurements: int) -> Matrix:
        """Return the sum of the jumps at each measurement, (measurements, n)."""
        columns = [np.bincount(self.at, jumps, measurements) for jumps in self.jumps.T]
        return np.column_stack(columns)


class MissedEvents:
    """Follows the missed events along a run; all measurements lie on a grid of ``period_ns``."""

    def __init__(self, H: Matrix, period_ns: int) -> None:
        self._propagate, self._period_ns = Propagator(H), period_ns
        # One entry per event that is still missing:
        self._sequences, self._times_ns = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._errors = np.zeros((0, len(H)))

    def take(
        self,
        t_ns: NDArray[np.int64],
        e_s: Matrix,
        events: NDArray[np.int64],
        received: NDArray[np.int64],
    ) -> Iterator[MissedJumps]:
        """Add k measurements; yield the jumps that are missed at them, some at a time.

        Args:
            t_ns: their times, (k,).
            e_s: e_s before any reset, (k, n).
            events: the sequence number of the event at each measurement, negative for none, (k,).
            received: that of the newest update that the controller has, negative for none, (k,).
        """
        new = np.flatnonzero(events >= 0)
        sequences = np.append(self._sequences, events[new])
        times_ns = np.append(self._times_ns, t_ns[new])
        errors = np.concatenate([self._errors, e_s[new]])
        begins = np.append(np.zeros(len(self._sequences), np.int64), new)
        ends = np.maximum(np.searchsorted(np.maximum.accumulate(received), sequences), begins)
        lasting = ends == len(t_ns)
        self._sequences, self._times_ns = sequences[lasting], times_ns[lasting]
        self._errors = errors[lasting]
        lengths = ends - begins
        totals = np.cumsum(lengths)
        first, most = 0, max(_PART_NUMBERS // errors.shape[1], 1)
        while first < len(lengths):
            done = totals[first - 1] if first else 0
            last = max(int(np.searchsorted(totals, done + most, "right")), first + 1)
            which = np.repeat(np.arange(first, last), lengths[first:last])
            at = np.arange(len(which)) - (totals - lengths)[which] + done + begins[which]
            periods = (t_ns[at] - times_ns[which]) // self._period_ns
            jumps = self._propagate.leaps(errors[which], periods, self._period_ns)
            yield MissedJumps(at, times_ns[which], periods, jumps)
            first = last


def missed_sum(missed: Iterator[MissedJumps], measurements: int, n: int) -> Vector:
    """Return the right-hand side of (I1) at each measurement, (measurements, n)."""
    return sum((one.sums(measurements) for one in missed), np.zeros((measurements, n)))


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
        """Add k measurements, as :meth:`MissedEvents.take` does."""
        count = len(t_ns)
        weighted = e_s if self._trigger.weight is None else e_s @ self._weight.T
        identity = np.where(events >= 0, 0.0, row_norms(weighted))
        printed, missed = self._thresholds(t_ns), np.zeros_like(e_s)
        for pairs in self._missed.take(t_ns, e_s, events, received):
            jumps = pairs.jumps if self._trigger.weight is None else pairs.jumps @ self._weight.T
            identity += np.bincount(pairs.at, row_norms(jumps), count)
            missed += pairs.sums(count)
            if isinstance(self._trigger, TriggerRule) and self._trigger.is_decaying:
                grown = self._growths.at(pairs.periods) * self._thresholds(pairs.event_ns)
                printed += np.bincount(pairs.at, grown, count)
        return ErrorBounds(identity, printed, missed)

    def _thresholds(self, t_ns: NDArray[np.int64]) -> Vector:
        if isinstance(self._trigger, TriggerRule) and self._trigger.is_decaying:
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

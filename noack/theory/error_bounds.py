"""Bounds of ‖e_c‖ along a run, from the sensor's errors and the controller's updates.

By (I1), e_c = e_s + Σ e^{H(t−t_k)} e_s(t_k⁻) over the missing events. Two bounds follow:

* the identity's: ‖e_s‖ + Σ ‖e^{H(t−t_k)} e_s(t_k⁻)‖, for every plant, trigger and network;
* the paper's eq:LossEv3: βe^{−αt} + Σ βe^{−αt_k} ‖e^{H(t−t_k)}‖, for a continuous trigger.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Propagator, Vector, norm, row_norms
from noack.trigger.decaying import DecayingTrigger
from noack.trigger.trigger_rule import Policy


class ErrorBounds(NamedTuple):
    """Bounds of ‖e_c‖_W at one time."""

    identity: float
    printed: float
    """The paper's formula; NaN for other triggers than the paper's."""


class ErrorMonitor:
    """Computes the bounds along a run, measurement by measurement.

    A measurement needs a few array operations over the missing events: a network without a bound
    may lose thousands of consecutive updates. H is the matrix of both models between updates; times
    of measurements differ by multiples of ``period_ns``.
    """

    def __init__(self, H: Matrix, trigger: Policy, period_ns: int) -> None:
        n = len(H)
        self._trigger = trigger
        self._propagate = Propagator(H)
        self._weight = np.eye(n) if trigger.weight is None else trigger.weight
        self._is_unweighted = trigger.weight is None
        self._inverse = np.linalg.inv(self._weight)
        self._t_ns = 0
        # One entry per missing event, in order of the events:
        self._sequences = np.zeros(0, dtype=np.int64)
        self._thens_ns = np.zeros(0, dtype=np.int64)
        self._thresholds = np.zeros(0)
        self._jumps = np.zeros((0, n))  # e^{H(t−t_k)} e_s(t_k⁻)
        self._period_ns = period_ns
        self._growths = np.ones(0)
        """‖e^{Hτ}‖_W at the multiples of the period."""

    def sample(self, t_ns: int, e_s: Vector, event: int, received: int) -> ErrorBounds:
        """Add a measurement with e_s before any reset, (n,); return the bounds at its time.

        ``event`` is the sequence number of the event at this measurement, ``received`` that of the
        newest update that the controller has; both are negative for none.
        """
        self._jumps = self._propagate.rows(self._jumps, t_ns - self._t_ns)
        self._t_ns = t_ns
        if event >= 0:
            self._append(event, e_s)
        self._keep(self._sequences > received)
        identity = 0.0 if event >= 0 else norm(self._weight @ e_s)
        return ErrorBounds(
            identity + float(row_norms(self._jumps @ self._weight.T).sum()),
            self._threshold(t_ns) + self._grown_thresholds(t_ns),
        )

    def samples(
        self,
        t_ns: NDArray[np.int64],
        e_s: Matrix,
        events: NDArray[np.int64],
        received: NDArray[np.int64],
    ) -> Matrix:
        """Add k measurements as :meth:`sample` does; return both bounds, (k, 2)."""
        found = np.zeros((len(t_ns), 2))
        changes = [*np.flatnonzero(events >= 0).tolist(), len(t_ns)]
        place = 0
        for event in changes:
            while place < event:
                arrived = np.flatnonzero(received[place:event] >= self._oldest)
                end = place + int(arrived[0]) if len(arrived) else event
                if place < end:
                    found[place:end] = self._stretch(t_ns[place:end], e_s[place:end])
                if end < event:
                    found[end] = self.sample(int(t_ns[end]), e_s[end], -1, int(received[end]))
                place = end + 1
            if event < len(t_ns):
                number, newest = int(events[event]), int(received[event])
                found[event] = self.sample(int(t_ns[event]), e_s[event], number, newest)
            place = event + 1
        return found

    @property
    def _oldest(self) -> int:
        """The oldest missing event; without one, a number that no update has."""
        return int(self._sequences[0]) if len(self._sequences) else 2**63 - 1

    def _stretch(self, t_ns: NDArray[np.int64], e_s: Matrix) -> Matrix:
        """Return the bounds at k measurements between which the missing events are the same."""
        times_ns = t_ns.tolist()
        weighted = e_s if self._is_unweighted else np.array([self._weight @ e for e in e_s])
        identity = np.array([math.hypot(*e) for e in weighted.tolist()])
        printed = np.array([self._threshold(one_ns) for one_ns in times_ns])
        if missing := len(self._sequences):
            jumps = []
            for one_ns in times_ns:
                self._jumps = self._propagate.rows(self._jumps, one_ns - self._t_ns)
                self._t_ns = one_ns
                jumps.append(self._jumps)
            norms = row_norms(np.concatenate(jumps) @ self._weight.T)
            identity += norms.reshape(-1, missing).sum(axis=1)
            if isinstance(self._trigger, DecayingTrigger):
                printed += [self._grown_thresholds(one_ns) for one_ns in times_ns]
        self._t_ns = times_ns[-1]
        return np.column_stack([identity, printed])

    def _append(self, event: int, e_s: Vector) -> None:
        self._sequences = np.append(self._sequences, event)
        self._thens_ns = np.append(self._thens_ns, self._t_ns)
        self._thresholds = np.append(self._thresholds, self._threshold(self._t_ns))
        self._jumps = np.vstack([self._jumps, e_s])

    def _threshold(self, t_ns: int) -> float:
        trigger = self._trigger
        return trigger.threshold(t_ns) if isinstance(trigger, DecayingTrigger) else math.nan

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        if not kept.all():
            self._sequences, self._thens_ns = self._sequences[kept], self._thens_ns[kept]
            self._thresholds, self._jumps = self._thresholds[kept], self._jumps[kept]

    def _grown_thresholds(self, t_ns: int) -> float:
        """Return the sum of the missing events' thresholds, each times ‖e^{Hτ}‖_W of its age."""
        if not len(self._thens_ns) or not isinstance(self._trigger, DecayingTrigger):
            return 0.0
        periods = (t_ns - self._thens_ns) // self._period_ns
        known, oldest = len(self._growths), int(periods[0])
        if oldest >= known:
            more = [self._growth(i * self._period_ns) for i in range(known, oldest + 1)]
            self._growths = np.append(self._growths, more)
        return float(self._growths[periods] @ self._thresholds)

    def _growth(self, age_ns: int) -> float:
        """Return ‖e^{Hτ}‖_W."""
        moved = self._weight @ self._propagate.transition(age_ns) @ self._inverse
        return float(np.linalg.norm(moved, 2))

"""Exact identities that follow from the update laws alone, for every plant.

(I1)  x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻)

where q is the last event and r the last event with a packet that the controller received. It
extends the paper's eq:LossEv2 to every loss pattern: x_s jumps by −e_s(t_k⁻) at each event, and x_c
misses the jumps of events r + 1 to q.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Propagator, Vector

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

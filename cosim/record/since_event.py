"""What is known at the newest event of a run, followed measurement by measurement."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.align import AlignedRun, Reals, in_common
from cosim.record.run_record import Rows
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Propagator
from noack.protocol.record_tables import NO_SEQUENCE

UNKNOWN = 2**62
"""Number of missing events where sensor and controller share no update."""


class SinceEvent(NamedTuple):
    """The newest event t_k at each of some measurements."""

    age_s: Reals
    """t − t_k, (k,); NaN before the first event."""
    predicted: Reals
    """e^{(A+BK)(t−t_k)} x(t_k), with the x that the sensor knows, (k, n); NaN before."""
    missing: NDArray[np.int64]
    """Number of events after the newest one that the controller has received, (k,)."""


class EventFollower:
    """Follows the newest event of a run of a resolved scenario."""

    def __init__(self, scenario: Scenario) -> None:
        loop = loop_of(scenario)
        self._scenario = scenario
        self._propagate = Propagator(loop.A + loop.B @ loop.K)
        self._x = np.full(loop.n, np.nan)
        self._event_ns = 0
        self._event = NO_SEQUENCE

    @np.errstate(all="ignore")  # a run may diverge
    def take(self, rows: Rows, aligned: AlignedRun) -> SinceEvent:
        """Return what follows from the newest event, at the next measurements."""
        t_ns, predicted = rows["t_ns"], np.empty_like(rows["x"])
        newest, begun_ns = np.empty_like(rows["event"]), np.empty_like(t_ns)
        events = np.flatnonzero(rows["event"] != NO_SEQUENCE).tolist()
        for begin, end in pairwise([0, *events, len(rows)]):
            following = begin
            if begin < end and rows["event"][begin] != NO_SEQUENCE:
                self._x, self._event_ns = rows["x"][begin], int(t_ns[begin])
                self._event = int(rows["event"][begin])
                predicted[begin], following = self._x, begin + 1
            predicted[following:end] = self._followed(t_ns[following:end])
            newest[begin:end], begun_ns[begin:end] = self._event, self._event_ns
        age_s = np.where(newest == NO_SEQUENCE, np.nan, (t_ns - begun_ns) * 1e-9)
        shared = in_common(self._scenario, aligned)
        return SinceEvent(age_s, predicted, np.where(shared, newest - aligned.received, UNKNOWN))

    def _followed(self, t_ns: NDArray[np.int64]) -> Reals:
        """Return the prediction at times of the measurements' grid, (k, n).

        A step count is followed bit by bit, so that a value does not depend on the other times.
        """
        found = np.tile(self._x, (len(t_ns), 1))
        period_ns = self._scenario.timing.measurement_period_ns
        counts = (t_ns - self._event_ns) // period_ns
        for bit in range(int(counts.max(initial=0)).bit_length()):
            rows = np.flatnonzero(counts >> bit & 1)
            leap, before = self._propagate.transition(period_ns << bit), found[rows]
            found[rows] = sum(leap[:, i] * before[:, i, None] for i in range(len(self._x)))
        return found

"""What is known at the newest event of a run, followed measurement by measurement."""

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
        self._t_ns = self._event_ns = 0
        self._event = NO_SEQUENCE

    def take(self, rows: Rows, aligned: AlignedRun) -> SinceEvent:
        """Return what follows from the newest event, at the next measurements."""
        predicted, begun_ns = np.empty_like(rows["x"]), np.empty(len(rows), np.int64)
        newest = np.empty(len(rows), np.int64)
        for i, (now_ns, event) in enumerate(
            zip(rows["t_ns"].tolist(), rows["event"].tolist(), strict=True)
        ):
            if event == NO_SEQUENCE:
                self._x = self._propagate(self._x, now_ns - self._t_ns)
            else:
                self._x, self._event_ns, self._event = rows["x"][i], now_ns, event
            self._t_ns = now_ns
            predicted[i], begun_ns[i], newest[i] = self._x, self._event_ns, self._event
        age_s = np.where(newest == NO_SEQUENCE, np.nan, (rows["t_ns"] - begun_ns) * 1e-9)
        shared = in_common(self._scenario, aligned)
        return SinceEvent(age_s, predicted, np.where(shared, newest - aligned.received, UNKNOWN))

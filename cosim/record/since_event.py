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
        self._event_ns = 0
        self._event = NO_SEQUENCE

    @np.errstate(all="ignore")  # a run may diverge
    def take(self, rows: Rows, aligned: AlignedRun) -> SinceEvent:
        """Return what follows from the newest event, at the next measurements."""
        new = np.flatnonzero(rows["event"] != NO_SEQUENCE)
        events = np.append(self._event, rows["event"][new])
        event_ns = np.append(self._event_ns, rows["t_ns"][new])
        x = np.concatenate([self._x[None], rows["x"][new]])
        newest = np.searchsorted(new, np.arange(len(rows)), "right")
        period_ns = self._scenario.timing.measurement_period_ns
        age_ns = rows["t_ns"] - event_ns[newest]
        predicted = self._propagate.leaps(x[newest], age_ns // period_ns, period_ns)
        age_s = np.where(events[newest] == NO_SEQUENCE, np.nan, age_ns * 1e-9)
        shared = in_common(self._scenario, aligned)
        missing = np.where(shared, events[newest] - aligned.received, UNKNOWN)
        self._event, self._event_ns, self._x = int(events[-1]), int(event_ns[-1]), x[-1]
        return SinceEvent(age_s, predicted, missing)

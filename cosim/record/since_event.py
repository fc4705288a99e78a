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
        self._t_ns = self._event_ns = 0
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
                self._x, self._t_ns = rows["x"][begin], int(t_ns[begin])
                self._event, self._event_ns = int(rows["event"][begin]), self._t_ns
                predicted[begin], following = self._x, begin + 1
            predicted[following:end] = self._followed(t_ns[following:end])
            newest[begin:end], begun_ns[begin:end] = self._event, self._event_ns
        age_s = np.where(newest == NO_SEQUENCE, np.nan, (t_ns - begun_ns) * 1e-9)
        shared = in_common(self._scenario, aligned)
        return SinceEvent(age_s, predicted, np.where(shared, newest - aligned.received, UNKNOWN))

    def _followed(self, t_ns: NDArray[np.int64]) -> Reals:
        """Return the prediction at the next times, (k, n)."""
        if not len(t_ns):
            return np.zeros((0, len(self._x)))
        steps_ns = np.diff(t_ns, prepend=self._t_ns)
        if (steps_ns == steps_ns[0]).all():
            leap = self._propagate.transition(int(steps_ns[0]))
            found = (leap @ self._x)[None]
            while len(found) < len(t_ns):
                found, leap = np.concatenate([found, found @ leap.T]), leap @ leap
        else:
            states = [self._x]
            for step_ns in steps_ns.tolist():
                states.append(self._propagate(states[-1], step_ns))
            found = np.array(states[1:])
        self._x, self._t_ns = found[len(t_ns) - 1], int(t_ns[-1])
        return np.asarray(found[: len(t_ns)])

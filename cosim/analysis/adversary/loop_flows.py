"""The loop as the processes run it, followed from event to event, and the objective on the way.

The loop is sampled, held and delayed, under every policy that is a rule. Disturbances and noise are
those that the scenario's seeds draw. t_0 < t_1 < … are the events of the run, and T is the horizon. The
adversary maximises

* error: sup_{t ≤ T} ‖W e_c(t)‖ / level(t);
* state: sup_{t ≤ T} ‖x(t)‖ / level(t);
* cost: ∫₀^T ‖x(t)‖² dt;
* inter-event: −min_i (t_{i+1} − t_i).

level(t) is the certificate's bound divided by its value at 0. The suprema are those at the plant's
steps; the integral is a sum over them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.sampled_loop import Numbers, Runs, SampledLoop, Scales
from noack.core.linear_systems import Matrix, Vector
from noack.theory.certificates.certified_bounds import Quantity, ScenarioCertificate


class Objective(StrEnum):
    """The value that the adversary maximises."""

    ERROR = "error"
    STATE = "state"
    COST = "cost"
    INTER_EVENT = "inter-event"

    @property
    def additive(self) -> bool:
        """Whether the values of segments are added; otherwise the largest one is the result."""
        return self is Objective.COST

    @property
    def initial_value(self) -> float:
        """The value of a run without segments."""
        return 0.0 if self.additive else -np.inf

    def combine(self, earlier: Matrix, later: Matrix) -> Matrix:
        """Return the value of two successive parts of a run."""
        return np.asarray(earlier + later if self.additive else np.maximum(earlier, later))


Pattern = tuple[bool, ...]
"""Whether the update of each event is delivered; events after its end are delivered."""
Flags = NDArray[np.bool_]


class SegmentEnds(NamedTuple):
    """The ends of N segments: the next event, or the horizon."""

    end_s: Vector
    """(N,)"""
    z: Matrix
    """The runs' states at the end, before the event, (N, entries)."""
    is_event: Flags
    """Whether the segment ends in an event, not at the horizon or by divergence, (N,)."""
    value: Vector
    """The segment's value, (N,); infinite if the loop diverged."""
    at_s: Vector | None = None
    """Where each is reached, (N,), if the flow knows that."""


_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class SampledFlow:
    """A loop whose runs are followed from event to event; a run's state is a row of numbers.

    Values are relative to the shape of a certificate's bounds: the bound of ‖x‖ is X(0) · level(t),
    with level(0) = 1; the value is sup ‖x‖ / level(t). That of
    ‖W e_c‖ likewise. Without a certificate the level is 1.
    """

    loop: SampledLoop
    objective: Objective
    certificate: ScenarioCertificate
    _scales: Scales = field(init=False, compare=False)

    def __post_init__(self) -> None:
        """Compute the levels."""
        scales = Scales(
            self.loop.weight,
            *(
                bound[0] / np.maximum(bound, _TINY) if bound[0] > 0 else np.ones(len(bound))
                for bound in (self._bound(of_error=True), self._bound(of_error=False))
            ),
        )
        object.__setattr__(self, "_scales", scales)

    @property
    def horizon_s(self) -> float:
        """End of the runs."""
        return self.loop.last * self.loop.step_s

    @property
    def certified(self) -> float | None:
        """The certificate's bound of the objective; None without one."""
        if self.objective is Objective.INTER_EVENT:
            return self.certificate.inter_event_s
        if not self.certificate.has("e_c" if self.objective is Objective.ERROR else "x"):
            return None
        bound = self._bound(of_error=self.objective is Objective.ERROR)
        if self.objective is Objective.COST:
            return float((bound[1:] ** 2).sum() * self.loop.step_s)
        return float(bound[0])

    def start(self) -> SegmentEnds:
        """Return the start of all runs: after the first packet, or with x(0) known."""
        runs = self.loop.start()
        value = self.objective.initial_value
        if self.objective is Objective.STATE:
            value = float(np.linalg.norm(runs.x[0]))
        return SegmentEnds(self._time(runs.step), _pack(runs), runs.is_event, np.array([value]))

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """Return the states just after events at times (N,); ``delivered`` updates arrive."""
        runs = self._runs(t_s, z)
        self.loop.transmit(runs, delivered)
        return _pack(runs)

    def __call__(self, t_s: Vector, z: Matrix) -> SegmentEnds:
        """Follow N runs from times (N,), just after events, to their next events."""
        runs = self._runs(t_s, z)
        self.loop.follow(runs, self._scales, np.full(len(t_s), self.loop.last))
        end_s = at_s = self._time(runs.step)
        value = self._value(runs)
        if self.objective is Objective.INTER_EVENT:
            value = np.where(runs.is_event & (t_s >= 0.0), t_s - end_s, -np.inf)
        elif not self.objective.additive:
            of_error = self.objective is Objective.ERROR
            at_s = self._time(runs.error_at if of_error else runs.state_at)
        return SegmentEnds(end_s, _pack(runs), runs.is_event, value, at_s)

    def value_ahead(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """Return the value over a window without events, (N,); only the order counts.

        Large errors of the controller lead to early events.
        """
        runs = self._runs(t_s, z)
        last_step = np.minimum(runs.step + round(window_s / self.loop.step_s), self.loop.last)
        self.loop.follow(runs, self._scales, last_step, tests=False)
        return self._value(runs)

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """Return numbers of size 1 that are nearly equal for runs that nearly coincide, (N, k)."""
        runs = self._runs(t_s, z)
        step = np.maximum(runs.step, 0)
        state, error = self._scales.state[step, None], self._scales.error[step, None]
        quantities = [
            runs.x * state,
            (runs.x_s - runs.y) * error,
            (runs.x_c - runs.y) * error,
            runs.u * state,
            runs.updates.reshape(len(z), -1) * state,
            runs.sent,
            runs.auxiliary[:, None],
        ]
        return np.hstack([quantity / (np.abs(quantity).max(initial=0.0) or 1.0) for quantity in quantities])

    def _time(self, step: Numbers) -> Vector:
        return np.asarray(step * self.loop.step_s, dtype=np.float64)

    def _value(self, runs: Runs) -> Vector:
        """Return the value of segments, (N,)."""
        if self.objective is Objective.STATE:
            return runs.state
        return runs.cost if self.objective is Objective.COST else runs.error

    def _bound(self, *, of_error: bool) -> Vector:
        """Return the bound of ‖W e_c‖ or of ‖x‖ at each step; 1 without a certificate."""
        t_s = self._time(np.arange(self.loop.last + 1))
        quantity: Quantity = "e_c" if of_error else "x"
        if not self.certificate.has(quantity):
            return np.ones(len(t_s))
        return self.certificate.bound(t_s, quantity)

    def _runs(self, t_s: Vector, z: Matrix) -> Runs:
        """Return runs with a copy of states in rows, (N, entries)."""
        runs = self.loop.empty(len(t_s))
        step: Numbers = np.rint(t_s / self.loop.step_s).astype(np.int64)
        runs.step[:] = step
        begin = 0
        for array in _states(runs):
            columns = math.prod(array.shape[1:])
            array[:] = z[:, begin : begin + columns].reshape(array.shape)
            begin += columns
        return runs


def _states(runs: Runs) -> tuple[Matrix, ...]:
    """Return the arrays of which a run's state consists."""
    return (runs.x, runs.y, runs.x_s, runs.x_c, runs.u, runs.u_next, runs.sent, runs.updates, runs.auxiliary)


def _pack(runs: Runs) -> Matrix:
    """Return the states in rows, (N, entries)."""
    count = len(runs.step)
    return np.hstack([array.reshape(count, math.prod(array.shape[1:])) for array in _states(runs)])


class SampledRun(NamedTuple):
    """A run of the loop, by its events."""

    value: float
    at_s: float | None
    """Time of the supremum, or of the later of the two closest events."""
    delivered: Pattern
    """Whether the update of each event is delivered."""
    event_s: tuple[float, ...]


def run_sampled(flow: SampledFlow, delivered: Callable[[int], bool]) -> SampledRun:
    """Run the loop; ``delivered`` returns the fate of each update."""
    segment = flow.start()
    value, at_s = float(segment.value[0]), 0.0
    event_s = [] if flow.loop.known_start else [0.0]
    fates = [True] * len(event_s)
    while True:
        segment = flow(segment.end_s, segment.z)
        segment_value = float(segment.value[0])
        if segment.at_s is not None and segment_value > value:
            at_s = float(segment.at_s[0])
        value = float(flow.objective.combine(np.array(value), np.array(segment_value)))
        if not segment.is_event[0]:
            break
        fates.append(delivered(len(event_s)))
        event_s.append(float(segment.end_s[0]))
        segment = segment._replace(z=flow.after_events(segment.end_s, segment.z, np.array(fates[-1:])))
    known = flow.objective is not Objective.COST and math.isfinite(value)
    return SampledRun(value, at_s if known else None, tuple(fates), tuple(event_s))

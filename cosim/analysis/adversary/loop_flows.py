"""The loops of the search, followed from event to event, and the objective on the way.

z = (x, e_s, e_c) as in :mod:`cosim.simulation.continuous`. The level decays like the threshold,
t_0 < t_1 < … are the events of the run, and T is the horizon. The adversary maximises

* error: sup_{t ≤ T} ‖W e_c(t)‖ / level(t), the observed Δ;
* state: sup_{t ≤ T} ‖x(t)‖ β / level(t), the observed X;
* cost: ∫₀^T ‖x(t)‖² dt;
* inter-event: −min_i (t_{i+1} − t_i).

level(t) = βe^{−rt} with r = α, unless a certificate has another decay rate. If the threshold has a
floor ε and r = α, the level is the threshold max(βe^{−αt}, ε).

:class:`SegmentFlow` is the paper's loop in continuous time. The core computes events and values
(native/exact/): they are those of an exact run. A supremum is at most a share of 1e-10 above the
returned value, which is attained.

:class:`SampledFlow` is the loop as the processes run it: every policy, sampled, held and delayed.
Disturbances and noise are those that the scenario's seeds draw. The suprema are those at the
plant's steps; the integral is a sum over them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.simulation.continuous import ContinuousLoop, ContinuousRun
from cosim.simulation.exact_simulation import DIVERGED, OK, ExactSimulation
from cosim.simulation.sampled_loop import Numbers, Runs, SampledLoop, Scales
from noack.core.core_library import core
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.theory.certificates.certified_bounds import Quantity, ScenarioCertificate

_GRAMIAN_POINTS = 12
"""Points of the quadrature (Gauss and Legendre) of the integral over a window."""


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


@dataclass(frozen=True)
class Measure:
    """An objective of a given loop: values of segments between events, and their combination."""

    objective: Objective
    output: Matrix | None
    """C of the evaluated output y = C z, (q, 3n); None if the objective uses event times only."""
    beta: float
    """The level at t = 0."""
    rate_per_s: float = 0.0
    """r, the level's decay rate; 0 for the cost."""
    floor: float = 0.0
    """The smallest value of the level."""

    def level(self, t_s: Matrix) -> Matrix:
        """Return the level at times (k,), divided by its value at 0."""
        level = np.exp(-self.rate_per_s * t_s)
        return np.asarray(np.maximum(level, self.floor / self.beta) if self.floor else level)


def measure_of(system: ContinuousLoop, objective: Objective, rate_per_s: float | None = None) -> Measure:
    """Make a loop's measure; its level decays at α unless ``rate_per_s`` is given."""
    n, trigger = system.loop.n, system.decaying
    if objective is Objective.INTER_EVENT:
        return Measure(objective, None, trigger.level)
    output = np.zeros((n, 3 * n))
    if objective is Objective.ERROR:
        output[:, 2 * n :] = weight_of(system) / trigger.level
    else:
        output[:, :n] = np.eye(n)
    if objective is Objective.COST:
        return Measure(objective, output, trigger.level)
    rate_per_s = trigger.rate_per_s if rate_per_s is None else rate_per_s
    if trigger.floor >= trigger.level:  # the threshold is constant
        return Measure(objective, output, trigger.level)
    floor = trigger.floor if rate_per_s == trigger.rate_per_s else 0.0
    return Measure(objective, output, trigger.level, rate_per_s, floor)


def weight_of(system: ContinuousLoop) -> Matrix:
    """Return the matrix W of the trigger's norm, (n, n)."""
    weight = system.decaying.weight
    return np.eye(system.loop.n) if weight is None else weight


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


class PatternFlow(Protocol):
    """A loop whose runs are followed from event to event; a run's state is a row of numbers."""

    @property
    def objective(self) -> Objective:
        """What is maximised."""

    @property
    def horizon_s(self) -> float:
        """End of the runs."""

    def start(self) -> SegmentEnds:
        """Return the start of all runs: after the first packet, or with x(0) known."""

    def __call__(self, t_s: Vector, z: Matrix) -> SegmentEnds:
        """Follow N runs from times (N,), just after events, to their next events."""

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """Return the states just after events at times (N,); ``delivered`` updates arrive."""

    def value_ahead(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """Return how large the objective may become within a window, (N,); only the order counts."""

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """Return numbers of size 1 that are nearly equal for runs that nearly coincide, (N, k)."""


_MEASURES = {
    Objective.ERROR: core.NOACK_EXACT_ERROR,
    Objective.STATE: core.NOACK_EXACT_STATE,
    Objective.COST: core.NOACK_EXACT_COST,
    Objective.INTER_EVENT: core.NOACK_EXACT_TIMES,
}


class ObjectiveValue(NamedTuple):
    """The value of a run."""

    value: float
    at_s: float | None
    """Where a supremum is reached, or the later of the two closest events."""


class SegmentFlow:
    """Follows states to their next events, at most to the horizon.

    With ``known_start``, sensor and controller start from x(0), so there is no event at t = 0.
    """

    def __init__(
        self, system: ContinuousLoop, measure: Measure, horizon_s: float, *, known_start: bool
    ) -> None:
        self.system, self.measure, self.horizon_s = system, measure, horizon_s
        self.known_start = known_start
        self._gramians: dict[float, Matrix] = {}

    @property
    def objective(self) -> Objective:
        """The objective."""
        return self.measure.objective

    @cached_property
    def _simulation(self) -> ExactSimulation:
        """The loop, with the objective as its measure: ∫‖x‖² needs no weight of the input."""
        measure, m = self.measure, len(self.system.loop.K)
        until_s = math.inf
        if measure.floor and measure.rate_per_s:
            until_s = math.log(measure.beta / measure.floor) / measure.rate_per_s
        return self.system.simulation(
            self.horizon_s,
            known_start=True,
            R=np.zeros((m, m)),
            measure=_MEASURES[measure.objective],
            fading_per_s=measure.rate_per_s,
            fading_until_s=until_s,
        )

    def start(self) -> SegmentEnds:
        """As :meth:`PatternFlow.start`: sensor and controller have x(0)."""
        x0, zero = self.system.loop.x0, np.zeros(1)
        z = np.concatenate([x0, np.zeros(2 * len(x0))])[None]
        return SegmentEnds(zero, z, zero > 0, zero + self.objective.initial_value)

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """As :meth:`PatternFlow.after_events`: e_s ← 0, and e_c ← 0 if the update arrives."""
        z, n = z.copy(), z.shape[1] // 3
        z[:, n : 2 * n] = 0.0
        z[delivered, 2 * n :] = 0.0
        return z

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """As :meth:`PatternFlow.features`."""
        scaled = z / self.measure.level(t_s)[:, None]
        return np.asarray(scaled / (np.abs(scaled).max() or 1.0))

    def value_ahead(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """As :meth:`PatternFlow.value_ahead`: the integral of the output's square."""
        if window_s not in self._gramians:
            self._gramians[window_s] = _gramian(self.system, self.measure, window_s)
        scaled = z / self.measure.level(t_s)[:, None]
        return np.asarray(np.einsum("ai,ij,aj->a", scaled, self._gramians[window_s], scaled))

    def __call__(self, t_s: Vector, z: Matrix) -> SegmentEnds:
        """As :meth:`PatternFlow.__call__`, with z = (x, e_s, e_c), (N, 3n).

        Raises:
            CallerError: an event or a supremum cannot be decided.
        """
        loop, measure, n = self.system.loop, self.measure, self.system.loop.n
        ends = self._simulation.segments(loop.A, loop.B, t_s, z.reshape(-1, 3, n))
        if not np.isin(ends.statuses, (OK, DIVERGED)).all():
            raise CallerError("trigger: an error stays too close to a level to decide when it passes")
        diverged, is_event = ends.statuses == DIVERGED, ends.events == 1
        z = ends.states.reshape(-1, 3 * n)
        if measure.objective is Objective.INTER_EVENT:
            between_events = is_event & ((t_s > 0) | (not self.known_start))
            value = np.where(between_events, t_s - ends.t_s, -math.inf)
        else:
            value = ends.values / (measure.beta if measure.objective is Objective.ERROR else 1.0)
        value = np.where(diverged, math.inf, value)
        return SegmentEnds(ends.t_s, z, is_event & ~diverged, value, ends.at_s)


def evaluate(run: ContinuousRun, measure: Measure) -> ObjectiveValue:
    """Return the objective along a run; infinite if the run diverged.

    The inter-event time has the sign of the objective: negative, or −∞ with fewer than two events.
    """
    if measure.output is None:
        between_s = np.diff(run.event_s)
        if not len(between_s):
            return ObjectiveValue(-math.inf, None)
        shortest = int(between_s.argmin())
        return ObjectiveValue(-float(between_s[shortest]), float(run.event_s[shortest + 1]))
    if run.diverged_at_s is not None:
        return ObjectiveValue(math.inf, run.diverged_at_s)
    # With a first packet the run starts at event 0.
    first_event = 1 if len(run.event_s) and run.event_s[0] == 0.0 else 0
    t_s, starts = np.array([0.0, *run.event_s])[first_event:], run.starts[first_event:]
    flow = SegmentFlow(run.system, measure, run.horizon_s, known_start=True)
    segments = flow(t_s, starts.reshape(len(starts), -1))
    if measure.objective is Objective.COST:
        return ObjectiveValue(float(segments.value.sum()), None)
    highest = int(segments.value.argmax())
    assert segments.at_s is not None
    return ObjectiveValue(float(segments.value[highest]), float(segments.at_s[highest]))


def _gramian(system: ContinuousLoop, measure: Measure, window_s: float) -> Matrix:
    """Return ∫₀^window e^{Gᵀs} Cᵀ C e^{Gs} ds, scaled like the objective; CᵀC for event times."""
    n = system.loop.n
    if measure.output is None:  # the initial speed of e_s
        speed = weight_of(system) @ system.generator[n : 2 * n]
        return np.asarray(speed.T @ speed)
    generator = system.generator + measure.rate_per_s * np.eye(3 * n)
    points, weights = np.polynomial.legendre.leggauss(_GRAMIAN_POINTS)
    total = np.zeros_like(generator)
    for s, weight in zip((points + 1) / 2 * window_s, weights / 2 * window_s, strict=True):
        y = measure.output @ expm(generator * s)
        total += weight * (y.T @ y)
    return total


_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class SampledFlow:
    """A :class:`PatternFlow`; values are relative to the shape of a certificate's bounds.

    The bound of ‖x‖ is X(0) · level(t), with level(0) = 1; the value is sup ‖x‖ / level(t). That of
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
        """As :meth:`PatternFlow.start`."""
        runs = self.loop.start()
        value = self.objective.initial_value
        if self.objective is Objective.STATE:
            value = float(np.linalg.norm(runs.x[0]))
        return SegmentEnds(self._time(runs.step), _pack(runs), runs.is_event, np.array([value]))

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """As :meth:`PatternFlow.after_events`."""
        runs = self._runs(t_s, z)
        self.loop.transmit(runs, delivered)
        return _pack(runs)

    def __call__(self, t_s: Vector, z: Matrix) -> SegmentEnds:
        """As :meth:`PatternFlow.__call__`."""
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
        """As :meth:`PatternFlow.value_ahead`: the value over the window without events.

        Large errors of the controller lead to early events.
        """
        runs = self._runs(t_s, z)
        last_step = np.minimum(runs.step + round(window_s / self.loop.step_s), self.loop.last)
        self.loop.follow(runs, self._scales, last_step, tests=False)
        return self._value(runs)

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """As :meth:`PatternFlow.features`."""
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

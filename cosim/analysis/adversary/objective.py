"""The objectives that the adversary maximises along a run.

z = (x, e_s, e_c) as in :mod:`cosim.simulation.continuous`. The level decays like
the threshold, t_0 < t_1 < … are the run's events, and T is the horizon:

* error: sup_{t ≤ T} ‖W e_c(t)‖ / level(t), the observed Δ;
* state: sup_{t ≤ T} ‖x(t)‖ β / level(t), the observed X;
* cost: ∫₀^T ‖x(t)‖² dt;
* inter-event: −min_i (t_{i+1} − t_i).

level(t) = βe^{−rt} with r = α, unless a certificate has another decay rate. If the threshold has a
floor ε and r = α, the level is the threshold max(βe^{−αt}, ε).

Segments of runs with these values, from event to event, are what a flow computes: that of the
paper's loop and that of the sampled loop (:mod:`cosim.analysis.adversary.loop_flows`).
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.continuous import ContinuousLoop
from noack.core.linear_systems import Matrix, Vector


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
    def nothing(self) -> float:
        """The value of a run without segments."""
        return 0.0 if self.additive else -np.inf

    def joined(self, first: Matrix, second: Matrix) -> Matrix:
        """Return the value of two successive parts of a run."""
        return np.asarray(first + second if self.additive else np.maximum(first, second))


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
    floor = trigger.floor if rate_per_s == trigger.rate_per_s else 0.0
    return Measure(objective, output, trigger.level, rate_per_s, floor)


def weight_of(system: ContinuousLoop) -> Matrix:
    """Return the matrix W of the trigger's norm, (n, n)."""
    weight = system.decaying.weight
    return np.eye(system.loop.n) if weight is None else weight


Pattern = tuple[bool, ...]
"""Whether the update of each event is delivered; events after its end are delivered."""
Flags = NDArray[np.bool_]


class Segments(NamedTuple):
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
        ...

    @property
    def horizon_s(self) -> float:
        """End of the runs."""
        ...

    def start(self) -> Segments:
        """Return the start of all runs: after the first packet, or with x(0) known."""
        ...

    def __call__(self, t_s: Vector, z: Matrix, known: float = -np.inf) -> Segments:
        """Follow N runs from times (N,), just after events, to their next events.

        Results below ``known`` may be inaccurate.
        """
        ...

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """Return the states just after events at times (N,); ``delivered`` updates arrive."""
        ...

    def promise(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """Return how large the objective may become within a window, (N,), on any scale."""
        ...

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """Return numbers of size 1 that are nearly equal for runs that nearly coincide, (N, k)."""
        ...

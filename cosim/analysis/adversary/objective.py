"""The objectives that the adversary maximises along a run.

z = (x, e_s, e_c) as in :mod:`cosim.simulation.continuous`. The level decays like
the threshold, t_0 < t_1 < … are the run's events, and T is the horizon:

* error: sup_{t ≤ T} ‖W e_c(t)‖ / level(t), the observed Δ;
* state: sup_{t ≤ T} ‖x(t)‖ β / level(t), the observed X;
* cost: ∫₀^T ‖x(t)‖² dt;
* inter-event: −min_i (t_{i+1} − t_i).

level(t) = βe^{−rt} with r = α, unless a certificate has another decay rate. If the threshold has a
floor ε and r = α, the level is the threshold max(βe^{−αt}, ε).
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from cosim.simulation.continuous import ContinuousLoop
from noack.core.linear_systems import Matrix


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


def measure_of(
    system: ContinuousLoop, objective: Objective, rate_per_s: float | None = None
) -> Measure:
    """Make a loop's measure; its level decays at α unless ``rate_per_s`` is given."""
    n, trigger = system.loop.n, system.decaying
    if objective is Objective.INTER_EVENT:
        return Measure(objective, None, trigger.beta)
    output = np.zeros((n, 3 * n))
    if objective is Objective.ERROR:
        output[:, 2 * n :] = weight_of(system) / trigger.beta
    else:
        output[:, :n] = np.eye(n)
    if objective is Objective.COST:
        return Measure(objective, output, trigger.beta)
    rate_per_s = trigger.alpha_per_s if rate_per_s is None else rate_per_s
    floor = trigger.floor if rate_per_s == trigger.alpha_per_s else 0.0
    return Measure(objective, output, trigger.beta, rate_per_s, floor)


def weight_of(system: ContinuousLoop) -> Matrix:
    """Return the matrix W of the trigger's norm, (n, n)."""
    weight = system.decaying.weight
    return np.eye(system.loop.n) if weight is None else weight

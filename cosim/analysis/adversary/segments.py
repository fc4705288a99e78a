"""Follows states of the paper's loop to their next events, with the objective's value on the way.

The core does both (native/exact/): events and values are those of an exact run. A supremum is at
most a share of 1e-10 above the returned value, which is attained.
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cosim.analysis.adversary.objective import Measure, Objective, weight_of
from cosim.analysis.adversary.pattern_flow import Flags, Segments
from cosim.simulation.continuous import ContinuousLoop, ContinuousRun
from cosim.simulation.exact_simulation import DIVERGED, OK, ExactSimulation
from noack.core.core_library import core
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector

_GRAMIAN_POINTS = 12
_MEASURES = {
    Objective.ERROR: core.NOACK_EXACT_ERROR,
    Objective.STATE: core.NOACK_EXACT_STATE,
    Objective.COST: core.NOACK_EXACT_COST,
    Objective.INTER_EVENT: core.NOACK_EXACT_TIMES,
}


class Valued(NamedTuple):
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
            self.horizon_s, known_start=True, R=np.zeros((m, m)),
            measure=_MEASURES[measure.objective], fading_per_s=measure.rate_per_s,
            fading_until_s=until_s,
        )  # fmt: skip

    def start(self) -> Segments:
        """As :meth:`PatternFlow.start`: sensor and controller have x(0)."""
        x0, zero = self.system.loop.x0, np.zeros(1)
        z = np.concatenate([x0, np.zeros(2 * len(x0))])[None]
        return Segments(zero, z, zero > 0, zero + self.objective.nothing)

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

    def promise(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """As :meth:`PatternFlow.promise`: the integral of the output's square."""
        if window_s not in self._gramians:
            self._gramians[window_s] = _gramian(self.system, self.measure, window_s)
        scaled = z / self.measure.level(t_s)[:, None]
        return np.asarray(np.einsum("ai,ij,aj->a", scaled, self._gramians[window_s], scaled))

    def __call__(self, t_s: Vector, z: Matrix, known: float = -math.inf) -> Segments:
        """As :meth:`PatternFlow.__call__`, with z = (x, e_s, e_c), (N, 3n).

        Raises:
            CallerError: an event or a supremum cannot be decided.
        """
        loop, measure, n = self.system.loop, self.measure, self.system.loop.n
        found = self._simulation.segments(loop.A, loop.B, t_s, z.reshape(-1, 3, n))
        if not np.isin(found.statuses, (OK, DIVERGED)).all():
            raise CallerError(
                "trigger: an error stays too close to a level to decide when it passes"
            )
        diverged, is_event = found.statuses == DIVERGED, found.events == 1
        z = found.states.reshape(-1, 3 * n)
        if measure.objective is Objective.INTER_EVENT:
            between_events = is_event & ((t_s > 0) | (not self.known_start))
            value = np.where(between_events, t_s - found.t_s, -math.inf)
        else:
            value = found.values / (measure.beta if measure.objective is Objective.ERROR else 1.0)
        value = np.where(diverged, math.inf, value)
        return Segments(found.t_s, z, is_event & ~diverged, value, found.at_s)


def evaluate(run: ContinuousRun, measure: Measure) -> Valued:
    """Return the objective along a run; infinite if the run diverged.

    The inter-event time has the sign of the objective: negative, or −∞ with fewer than two events.
    """
    if measure.output is None:
        between_s = np.diff(run.event_s)
        if not len(between_s):
            return Valued(-math.inf, None)
        shortest = int(between_s.argmin())
        return Valued(-float(between_s[shortest]), float(run.event_s[shortest + 1]))
    if run.diverged_at_s is not None:
        return Valued(math.inf, run.diverged_at_s)
    # With a first packet the run starts at event 0.
    first = 1 if len(run.event_s) and run.event_s[0] == 0.0 else 0
    t_s, starts = np.array([0.0, *run.event_s])[first:], run.starts[first:]
    flow = SegmentFlow(run.system, measure, run.horizon_s, known_start=True)
    found = flow(t_s, starts.reshape(len(starts), -1))
    if measure.objective is Objective.COST:
        return Valued(float(found.value.sum()), None)
    highest = int(found.value.argmax())
    assert found.at_s is not None
    return Valued(float(found.value[highest]), float(found.at_s[highest]))


def _gramian(system: ContinuousLoop, measure: Measure, window_s: float) -> Matrix:
    """Return ∫₀^window e^{Gᵀs} Cᵀ C e^{Gs} ds, scaled like the objective; CᵀC for event times."""
    n = system.loop.n
    if measure.output is None:  # the initial speed of e_s
        speed = weight_of(system) @ system.generator[n : 2 * n]
        return np.asarray(speed.T @ speed)
    from scipy.linalg import expm

    generator = system.generator + measure.rate_per_s * np.eye(3 * n)
    points, weights = np.polynomial.legendre.leggauss(_GRAMIAN_POINTS)
    total = np.zeros_like(generator)
    for s, weight in zip((points + 1) / 2 * window_s, weights / 2 * window_s, strict=True):
        y = measure.output @ expm(generator * s)
        total += weight * (y.T @ y)
    return total

"""The paper's loop between events, and the exact time of the next one.

In the coordinates z = (x, e_s, e_c) with e_s = x_s − x and e_c = x_c − x, the loop between events
is linear and autonomous. The errors keep their relative accuracy while all states decay:

    ẋ   = (A+BK) x + BK e_c
    ė_s = H e_s − E x − BK e_c          E = A + BK − H  (eq:miet_errdyn)
    ė_c = (H−BK) e_c − E x

with H = Â+B̂K in model mode and H = 0 under zero-order hold. An event is the first t > t_i at which
‖W e_s(t)‖ exceeds max(βe^{−αt}, ε) (eq:thre). There e_s ← 0, and e_c ← 0 if the update arrives.

No crossing is skipped. While the threshold is βe^{−αt}, the scaled error
y(t) = W e_s(t) / (βe^{−αt}) is also the output of a linear system: [0 W 0] e^{(G+αI)(t−t₀)} z(t₀)
divided by the threshold at t₀. The event is the time at which the curve y leaves the unit ball. If
the floor ε replaces βe^{−αt}, the same holds with α = 0. Time is divided into cells on which a
polynomial of degree 18 equals y up to rounding (:mod:`cosim.simulation.continuous.exact_flow`). The
control points of all cells of a window are one matrix-vector product. If all control points of a
cell are in the ball, y stays in the ball there (convex hull). In every other cell the roots of
1 − |y|² are isolated (:mod:`cosim.simulation.continuous.bernstein`).
No sampling is involved. Only rounding remains: an excursion above the threshold by less than a
share of about 1e-15 ‖z‖/threshold may be taken for a tangency and missed.

A run has diverged when ‖z‖ exceeds 1e100, or 1e100 times the threshold of e_s or x. This is tested
at the end of each window and at each event. Bisection between that time and the last event finds
the time of divergence.
"""

import math
from typing import NamedTuple

import numpy as np

from cosim.simulation.continuous.event_detector import (
    LARGEST,
    DetectedEvent,
    DivergedError,
    EventDetector,
    NormEventDetector,
    QuadraticEventDetector,
)
from cosim.simulation.continuous.exact_flow import ExactFlow, growth_rate
from cosim.simulation.continuous.integral_detector import IntegralEventDetector
from noack.config.resolution import LoopMatrices, loop_of, policy_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.trigger.decaying import DecayingTrigger
from noack.trigger.trigger_condition import QuadraticForm, TriggerCondition
from noack.trigger.trigger_policy import Policy

_SMALLEST_THRESHOLD = 1e-200
_LONGEST_CELL_S = 1e3
_GRID_SLACK = 1e-9
"""Tolerance for the rounding of an event's time on the grid, as a share of the period."""
_GRID_BLOCK = 256
_BISECTIONS = 60


class LoopState(NamedTuple):
    """The loop at a time: plant state and both models' errors, each of shape (n,)."""

    t_s: float
    x: Vector
    e_s: Vector
    e_c: Vector


class Samples(NamedTuple):
    """The loop at k times; states of shape (k, n)."""

    t_s: Vector
    x: Matrix
    e_s: Matrix
    e_c: Matrix

    @property
    def x_s(self) -> Matrix:
        """The sensor's model."""
        return self.x + self.e_s

    @property
    def x_c(self) -> Matrix:
        """The controller's model."""
        return self.x + self.e_c


class ContinuousLoop:
    """The loop in continuous time, under any policy."""

    def __init__(self, loop: LoopMatrices, trigger: Policy) -> None:
        self.loop = loop
        self.trigger = trigger
        n, H, BK = loop.n, loop.H, loop.B @ loop.K
        closed, none = loop.A + BK, np.zeros((n, n))
        E = closed - H
        self.generator: Matrix = np.block([[closed, none, BK], [-E, H, -BK], [-E, none, H - BK]])
        """G of dz/dt = G z, per second, shape (3n, 3n)."""
        self._rule = trigger.trigger_rule(n)
        condition = self._rule.after(0.0, loop.x0)
        scaled = self.generator + condition.rate_per_s * np.eye(3 * n)
        rate_per_s = max(growth_rate(self.generator), growth_rate(scaled))
        if condition.dynamic_variable is not None:
            rate_per_s = max(rate_per_s, condition.dynamic_variable.decay_per_s)
        self.flow = ExactFlow(self.generator, 1.0 / max(rate_per_s, 1.0 / _LONGEST_CELL_S))
        self._detectors: dict[tuple[bytes, float], EventDetector] = {}

    @property
    def decaying(self) -> DecayingTrigger:
        """The trigger, which must be the paper's.

        Raises:
            CallerError: the policy is another one.
        """
        if not isinstance(self.trigger, DecayingTrigger):
            raise CallerError(
                "trigger.policy: with a continuous trigger (--trigger continuous) only "
                '"decaying" is searched'
            )
        return self.trigger

    def threshold(self, t_s: float) -> float:
        """Return max(βe^{−αt}, ε) of the paper's trigger."""
        return self.decaying.threshold(t_s * 1e9)

    def norms(self, errors: Matrix) -> Vector:
        """‖W e‖ of k errors, shape (k, n) → (k,)."""
        W = self.trigger.weight
        norms: Vector = np.linalg.norm(errors if W is None else errors @ W.T, axis=-1)
        return norms

    def condition(self, state: LoopState) -> TriggerCondition:
        """Return the trigger condition after an event at a state."""
        return self._rule.after(state.t_s * 1e9, state.x)

    @np.errstate(over="ignore", invalid="ignore")  # a run may diverge
    def next_crossing(
        self,
        state: LoopState,
        until_s: float,
        condition: TriggerCondition,
        auxiliary: float = 0.0,
    ) -> tuple[LoopState, float] | None:
        """Return the next event in [``state.t_s``, ``until_s``], just before its reset.

        Args:
            state: the loop's state.
            until_s: end of the search.
            condition: the trigger condition.
            auxiliary: η or the integral at ``state``.

        Returns:
            State and auxiliary variable; None if there is no event. If ``state`` already exceeds
            the threshold, or equals it and grows, the event is at ``state``.

        Raises:
            DivergedError: the run diverges before an event; contains the time.
            CallerError: the threshold decays below 1e-200 before an event.
        """
        try:
            found = self._next_crossing(state, until_s, condition, auxiliary)
        except DivergedError as error:
            raise DivergedError(self._passed_s(state, error.t_s, condition)) from None
        end = self.propagate(state, max(until_s, state.t_s)) if found is None else found[0]
        if not self._is_within(end, condition):
            raise DivergedError(self._passed_s(state, end.t_s, condition))
        return found

    def _is_within(self, state: LoopState, condition: TriggerCondition) -> bool:
        """Return whether a state is small enough to compute with."""
        threshold, begins_ns = 0.0, min(condition.earliest_ns, condition.latest_ns)
        if len(condition.form.up) and state.t_s * 1e9 >= begins_ns:
            threshold = condition.threshold(state.t_s * 1e9)
        limit = LARGEST * (min(threshold, 1.0) if threshold > 0 else 1.0)
        return float(np.linalg.norm(np.concatenate(state[1:]))) < limit

    def _passed_s(self, state: LoopState, until_s: float, condition: TriggerCondition) -> float:
        """Return the time at which the loop diverged, given that it has diverged at ``until_s``."""
        low_s, high_s = state.t_s, until_s
        if not self._is_within(state, condition):
            return low_s
        for _ in range(_BISECTIONS):
            middle_s = (low_s + high_s) / 2
            if self._is_within(self.propagate(state, middle_s), condition):
                low_s = middle_s
            else:
                high_s = middle_s
        return high_s

    def _next_crossing(
        self, state: LoopState, until_s: float, condition: TriggerCondition, auxiliary: float
    ) -> tuple[LoopState, float] | None:
        t_s, z = state.t_s, np.concatenate(state[1:])
        latest_s = condition.latest_ns * 1e-9
        begin_s = min(condition.earliest_ns * 1e-9, latest_s)
        end_s = max(min(until_s, latest_s), t_s)
        if begin_s > t_s:
            if begin_s > until_s:
                return None
            z, auxiliary = self._advance(z, begin_s - t_s, condition, auxiliary)
            t_s = begin_s
        if len(condition.form.up):
            if condition.grid_ns:
                found = self._on_grid(z, t_s, state.t_s, end_s, condition)
            else:
                found = self._exit(z, t_s, end_s, condition, auxiliary)
            if found.exceeds:
                return self._state(t_s + found.after_s, found.z), found.auxiliary
            z, auxiliary = found.z, found.auxiliary
        else:
            z, auxiliary = self._advance(z, end_s - t_s, condition, auxiliary)
        return (self._state(end_s, z), auxiliary) if latest_s <= until_s else None

    def _exit(
        self, z: Vector, t_s: float, end_s: float, condition: TriggerCondition, auxiliary: float
    ) -> DetectedEvent:
        """Follow the loop until the comparison holds or ``end_s``: first decay, then floor."""
        begin_s, since_s = t_s, condition.since_ns * 1e-9
        floor_from_s, vanishes_s = -math.inf, math.inf
        if condition.level > condition.floor and condition.rate_per_s > 0:
            rate = condition.rate_per_s
            floor_from_s = vanishes_s = math.inf
            if condition.floor > 0:
                floor_from_s = since_s + math.log(condition.level / condition.floor) / rate
            vanishes_s = since_s + max(math.log(condition.level / _SMALLEST_THRESHOLD) / rate, 0.0)
        if t_s < floor_from_s:
            span_s = min(end_s, floor_from_s, vanishes_s) - t_s
            threshold = condition.threshold(t_s * 1e9)
            detector = self._detector(condition, condition.rate_per_s, threshold)
            found = detector.first_exit(z, t_s, threshold, span_s, auxiliary)
            if found.exceeds or end_s <= min(floor_from_s, vanishes_s):
                return found
            if vanishes_s < floor_from_s:
                raise vanished(vanishes_s, _SMALLEST_THRESHOLD)
            z, auxiliary, t_s = found.z, found.auxiliary, floor_from_s
        level = (
            condition.floor if condition.rate_per_s > 0 else max(condition.floor, condition.level)
        )
        detector = self._detector(condition, 0.0, level)
        found = detector.first_exit(z, t_s, level, end_s - t_s, auxiliary)
        return found._replace(after_s=found.after_s + t_s - begin_s)

    def _detector(
        self, condition: TriggerCondition, rate_per_s: float, threshold: float
    ) -> EventDetector:
        """Return the cached detector of a condition; with η, the threshold does not decay."""
        form, variable = condition.form, condition.dynamic_variable
        plain = not len(form.down) and threshold > 0 and variable is None
        rate_per_s = rate_per_s if threshold > 0 else 0.0
        kind = bytes([plain, condition.integrates])
        key = (form.up.tobytes() + form.down.tobytes() + kind, rate_per_s)
        if key not in self._detectors:
            size = len(self.generator)
            output = np.pad(form.up, ((0, 0), (0, size - form.up.shape[1])))
            if condition.integrates:
                made: EventDetector = IntegralEventDetector(
                    self.flow, self.generator, output, rate_per_s
                )
            elif plain:
                made = NormEventDetector(self.flow, self.generator, output, rate_per_s)
            else:
                gain = None if variable is None else variable.gain
                decay_per_s = 0.0 if variable is None else variable.decay_per_s
                made = QuadraticEventDetector(
                    self.flow, self.generator, form, rate_per_s, gain, decay_per_s
                )
            self._detectors[key] = made
        return self._detectors[key]

    def _advance(
        self, z: Vector, dt_s: float, condition: TriggerCondition, auxiliary: float
    ) -> tuple[Vector, float]:
        """Return state and auxiliary variable at the end of a span without comparison."""
        if not condition.has_auxiliary:
            return self.flow.advance(z, dt_s), auxiliary
        if condition.integrates:
            found = self._detector(condition, 0.0, math.inf).first_exit(
                z, 0.0, math.inf, dt_s, auxiliary
            )
        else:
            nothing = np.zeros((0, condition.form.up.shape[1]))
            idle = condition._replace(form=QuadraticForm(nothing, nothing))
            found = self._detector(idle, 0.0, 0.0).first_exit(z, 0.0, 0.0, dt_s, auxiliary)
        return found.z, found.auxiliary

    def _on_grid(
        self, z: Vector, t_s: float, event_s: float, end_s: float, condition: TriggerCondition
    ) -> DetectedEvent:
        """Evaluate the comparison at the grid times from ``t_s`` on, later than ``event_s``."""
        grid_s = condition.grid_ns * 1e-9
        first = max(
            math.ceil(t_s / grid_s - _GRID_SLACK), math.floor(event_s / grid_s + _GRID_SLACK) + 1
        )
        last = math.floor(end_s / grid_s + _GRID_SLACK)
        n = self.loop.n
        for begin in range(first, last + 1, _GRID_BLOCK):
            points_s = np.arange(begin, min(begin + _GRID_BLOCK, last + 1)) * grid_s
            states = self.flow.sample(z, np.maximum(points_s - t_s, 0.0))
            beyond = np.flatnonzero(~(np.linalg.norm(states, axis=1) < LARGEST))
            known = len(states) if not len(beyond) else int(beyond[0])
            z_known = states[:known, : 2 * n]
            exceeds = np.flatnonzero(condition.exceeds(points_s[:known] * 1e9, z_known))
            if len(exceeds):
                k = int(exceeds[0])
                return DetectedEvent(float(points_s[k]) - t_s, states[k], 0.0, exceeds=True)
            if len(beyond):
                raise DivergedError(float(points_s[beyond[0]]))
        return DetectedEvent(end_s - t_s, self.flow.advance(z, end_s - t_s), 0.0, exceeds=False)

    def propagate(self, state: LoopState, t_s: float) -> LoopState:
        """Return the state at ``t_s`` ≥ ``state.t_s``, without events in between."""
        return self._state(t_s, self.flow.advance(np.concatenate(state[1:]), t_s - state.t_s))

    def sample(self, state: LoopState, t_s: Vector) -> Samples:
        """Return the states at many times ≥ ``state.t_s``, without events in between."""
        t_s = np.asarray(t_s, dtype=np.float64)
        states = self.flow.sample(np.concatenate(state[1:]), t_s - state.t_s)
        return Samples(t_s, *np.split(states, 3, axis=1))

    def _state(self, t_s: float, z: Vector) -> LoopState:
        n = self.loop.n
        return LoopState(t_s, z[:n], z[n : 2 * n], z[2 * n :])


def vanished(from_s: float, smallest: float) -> CallerError:
    """Return the error of a threshold that decays too far."""
    return CallerError(
        f"trigger: from {from_s:g} s on the threshold is below {smallest:g}, where errors are "
        "within rounding; give trigger.floor or a shorter horizon"
    )


def reset(state: LoopState, delivered: bool) -> LoopState:
    """Return the state after an event: e_s = 0, and e_c = 0 if the update arrives."""
    nothing = np.zeros_like(state.e_s)
    return LoopState(state.t_s, state.x, nothing, nothing if delivered else state.e_c)


def continuous_loop_of(resolved: Scenario) -> ContinuousLoop:
    """Return the exact loop of a resolved scenario.

    Raises:
        CallerError: exact simulation does not support the scenario.
    """
    try:
        resolved.coverage.require_unchanging()
        resolved.coverage.require_exact()
    except CallerError as error:
        raise CallerError(f"with a continuous trigger (--trigger continuous): {error}") from None
    return ContinuousLoop(loop_of(resolved), policy_of(resolved))

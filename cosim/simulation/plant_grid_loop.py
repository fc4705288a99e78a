"""The loop on the plant's time grid, exact between grid points, with three implementation effects.

A real loop differs from the paper's loop by these effects:

* sampling, always on here: the trigger is tested at the measured steps only, and an update is sent
  at that step;
* delay, optional: an update acts on the controller's model x_c(t) some time after its event, as
  x_c ← e^{H(t−t_i)} x(t_i); only the newest update acts;
* held actuation, optional: the plant's input is constant over a step, u_k = K x_c(t'_k), with the
  model time t'_k of the actuation applied at step k. An update acts from the first step that
  applies an actuation computed from it.

Without held actuation the plant follows u = K x_c(t) continuously, as in
:mod:`cosim.simulation.continuous`; with it, by the exact zero-order hold that the live plant uses.
The trigger is that of the core, which the sensor has, too.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.continuous import ContinuousLoop
from noack.core.core_library import CoreMemory, core, ffi, pointer_to
from noack.core.linear_systems import Matrix, Vector, discretise
from noack.trigger_policies.trigger_rule import TriggerRule, fill_rule, rule_rows

NO_ACTUATION = -1
"""Model time of a step without any actuation yet."""
_BLOCK = 64
"""Steps that are computed at once."""


@dataclass(frozen=True)
class StepSchedule:
    """Times of the run's occurrences, in steps of the plant; K steps follow step 0."""

    period_ns: int
    """The plant's period."""
    measured: NDArray[np.bool_]
    """Whether the sensor tested the trigger at each step, (K + 1,); the last step is measured."""
    delivered: Callable[[int], bool]
    """Whether the update of each event arrives."""
    delay_ns: Callable[[int], int]
    """Model time from each delivered event to the update's effect on the controller's model."""
    delay_steps: Callable[[int], int]
    """Steps from each delivered event to the first one with an input computed from it."""
    model_ns: NDArray[np.int64]
    """Model time of the actuation held from each step on, (K + 1,); −1 if there is none yet."""


@dataclass(frozen=True)
class PlantGridRun:
    """A run on the plant's grid."""

    x: Matrix
    """State at each step, (K + 1, n)."""
    event_steps: NDArray[np.int64]
    """Step of each event."""


class PlantGridLoop:
    """The loop under a schedule."""

    def __init__(self, system: ContinuousLoop, schedule: StepSchedule, *, known_start: bool) -> None:
        self._system = system
        self._schedule = schedule
        self._known_start = known_start
        self._steps_s = np.arange(len(schedule.measured), dtype=np.float64)
        self._steps_s *= schedule.period_ns * 1e-9
        self._one_step = discretise(system.loop.A, system.loop.B, schedule.period_ns)

    @np.errstate(all="ignore")
    def run(self, *, delay: bool, hold: bool) -> PlantGridRun:
        """Simulate; once the state is not finite, it stays non-finite."""
        run = self._begin()
        while True:
            if run.is_event:
                self._take_event(run, delay=delay, hold=hold)
            self._apply_updates(run)
            if run.step == len(run.states) - 1:
                return PlantGridRun(run.states, np.array(run.event_steps, dtype=np.int64))
            self._advance(run, hold=hold)

    def _begin(self) -> "_Progress":
        """Return step 0, which is an event unless the start is known and passes the trigger."""
        x0, known_start = self._system.loop.x0, self._known_start
        states = np.empty((len(self._steps_s), len(x0)))
        states[0] = x0
        trigger = _CoreTrigger(self._system.trigger, len(x0))
        is_event = bool(self._schedule.measured[0])
        if known_start:
            trigger.start(0, x0)
            is_event = is_event and trigger.test(0, x0[None], np.zeros_like(x0)[None]) is not None
        start = _Update(-1, 0, 0, x0 if known_start else np.zeros_like(x0))
        return _Progress(states, trigger, x0, start, known_start, is_event)

    def _take_event(self, run: "_Progress", *, delay: bool, hold: bool) -> None:
        """Reset the sensor's model; the update of a delivered event is on its way from now on."""
        x, number = run.states[run.step], len(run.event_steps)
        now_ns = run.step * self._schedule.period_ns
        run.x_s, run.knows_state = x, True
        run.trigger.start(now_ns, x)
        run.event_steps.append(run.step)
        if self._schedule.delivered(number):
            wait_ns = self._wait_ns(number, hold=hold) if delay else 0
            run.in_flight.append(_Update(number, now_ns, now_ns + wait_ns, x))
            run.in_flight.sort(key=lambda update: update.acts_ns)

    def _apply_updates(self, run: "_Progress") -> None:
        """Apply the updates that act by now: the newest counts."""
        now_ns = run.step * self._schedule.period_ns
        while run.in_flight and run.in_flight[0].acts_ns <= now_ns:
            run.newest = max(run.newest, run.in_flight.pop(0), key=lambda update: update.number)

    def _advance(self, run: "_Progress", *, hold: bool) -> None:
        """Simulate to the next event, at most to the next update's effect or over a block of steps."""
        x, step, period_ns = run.states[run.step], run.step, self._schedule.period_ns
        last_step = min(step + _BLOCK, len(run.states) - 1)
        if run.in_flight:
            last_step = min(last_step, max(run.in_flight[0].acts_ns // period_ns, step + 1))
        steps_ahead = slice(step + 1, last_step + 1)
        if hold:
            run.states[steps_ahead] = self._states_under_held_inputs(x, run.newest, step, last_step)
        else:
            updates = [update for update in run.in_flight if update.acts_ns < last_step * period_ns]
            run.states[steps_ahead] = self._continuous(x, [run.newest, *updates], step, last_step)
        x_s = self._follow_model(run.x_s, self._steps_s[1 : last_step - step + 1])
        # What follows the first event is discarded.
        measured = np.flatnonzero(self._schedule.measured[steps_ahead])
        first = 0 if len(measured) else None
        if run.knows_state:
            block = run.states[steps_ahead][measured]
            times_ns = (step + 1 + measured) * period_ns
            first = run.trigger.test(times_ns, block, x_s[measured] - block)
        run.is_event = first is not None
        steps = last_step - step if first is None else int(measured[first]) + 1
        run.x_s = x_s[steps - 1]
        run.step += steps

    def _wait_ns(self, event: int, *, hold: bool) -> int:
        if hold:
            return self._schedule.delay_steps(event) * self._schedule.period_ns
        return self._schedule.delay_ns(event)

    def _continuous(self, x: Vector, updates: list["_Update"], step: int, last_step: int) -> Matrix:
        """Return x at the steps after ``step`` up to ``last_step``, under u = K x_c(t)."""
        now_ns, newest = step * self._schedule.period_ns, updates[0]
        # With further updates, there is one step; x advances from one update's effect to the next.
        for update in updates[1:]:
            x = self._states_after(x, newest, now_ns, np.array([(update.acts_ns - now_ns) * 1e-9]))[0]
            newest, now_ns = max(newest, update, key=lambda candidate: candidate.number), update.acts_ns
        if len(updates) == 1:
            return self._states_after(x, newest, now_ns, self._steps_s[1 : last_step - step + 1])
        end_ns = last_step * self._schedule.period_ns
        return self._states_after(x, newest, now_ns, np.array([(end_ns - now_ns) * 1e-9]))

    def _states_after(self, x: Vector, newest: "_Update", now_ns: int, after_s: Vector) -> Matrix:
        """Return x at ascending times after now, (k, n), while no other update acts."""
        x_c = self._follow_model(newest.x, np.array([(now_ns - newest.event_ns) * 1e-9]))[0]
        start = np.array([x, np.zeros_like(x), x_c - x])  # e_s does not act on the plant
        return self._system.follow(np.zeros(1), start[None], after_s).x

    def _follow_model(self, x: Vector, age_s: Vector) -> Matrix:
        """Return e^{H age} x for ascending ages, (k, n)."""
        start = np.array([x, np.zeros_like(x), np.zeros_like(x)])
        return self._system.follow(np.zeros(1), start[None], age_s).x_c

    def _states_under_held_inputs(self, x: Vector, newest: "_Update", step: int, last_step: int) -> Matrix:
        """Return x at the steps after ``step`` up to ``last_step``, under the inputs applied there."""
        model_ns = self._schedule.model_ns[step:last_step]
        age_ns = np.maximum(model_ns - newest.event_ns, 0)
        inputs = self._follow_model(newest.x, age_ns * 1e-9) @ self._system.loop.K.T
        inputs[model_ns == NO_ACTUATION] = 0.0
        Ad, Bd = self._one_step
        states = np.empty((last_step - step, len(x)))
        for i, forced in enumerate(inputs @ Bd.T):
            states[i] = x = Ad @ x + forced
        return states


class _Update(NamedTuple):
    """An update of the controller's model; number −1 is the controller's initial state."""

    number: int
    event_ns: int
    acts_ns: int
    x: Vector


@dataclass
class _Progress:
    """How far a run has been simulated."""

    states: Matrix
    """State at each step so far, (K + 1, n)."""
    trigger: "_CoreTrigger"
    x_s: Vector
    """The sensor's model at the present step."""
    newest: _Update
    """The newest update that acts on the controller's model."""
    knows_state: bool
    """Whether the sensor's model has started; if not, the next measurement is an event."""
    is_event: bool
    """Whether there is an event at the present step."""
    in_flight: list[_Update] = field(default_factory=list)
    """In the order in which they act."""
    event_steps: list[int] = field(default_factory=list)
    step: int = 0


class _CoreTrigger:
    """Tests measurements as the sensor does: the core's trigger."""

    def __init__(self, rule: TriggerRule, n: int) -> None:
        self._n, self._memory, start = n, CoreMemory(), rule.initial_dynamic_variable
        self._rule, self._sides = ffi.new("noack_trigger_rule *"), ffi.new("double[2]")
        fill_rule(self._rule, rule, n, self._memory)
        self._state = ffi.new("noack_trigger_state *", {"auxiliary": start, "event_ns": -1})
        self._scratch = self._memory.zeros(4 * n + rule_rows(rule))

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event, at a state of shape (n,)."""
        x = np.ascontiguousarray(x)
        core.noack_trigger_start(
            self._rule, self._state, self._n, t_ns, pointer_to(x, "double *"), self._scratch
        )

    def test(self, t_ns: NDArray[np.int64] | int, x: Matrix, e_s: Matrix) -> int | None:
        """Test k successive measurements, (k, n), up to the first event; return its index."""
        x, e_s = np.ascontiguousarray(x), np.ascontiguousarray(e_s)
        states, errors = pointer_to(x, "double *"), pointer_to(e_s, "double *")
        for i, at_ns in enumerate(np.atleast_1d(t_ns).tolist()):
            if core.noack_trigger_test(
                self._rule,
                self._state,
                self._n,
                at_ns,
                states + i * self._n,
                errors + i * self._n,
                self._sides,
                self._scratch,
            ):
                return i
        return None

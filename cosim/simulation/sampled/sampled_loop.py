"""Makes the data of a scenario's loop for :mod:`cosim.simulation.sampled.loop_steps`."""

from copy import copy
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.sampled import loop_steps
from cosim.simulation.sampled.loop_steps import NO_TICK, Loop, Numbers, Rule, Runs, Scales, Scratch
from noack.config.resolution import LoopMatrices, loop_of, policy_of
from noack.config.scenario import Scenario
from noack.config.state_estimation import assumed_model
from noack.core import ordered_arithmetic
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, discretise, transition
from noack.theory.run_conditions import network_delay_ns
from noack.trigger import self_triggered_interval, trigger_arrays
from noack.trigger.self_triggered_interval import Forecast
from noack.trigger.trigger_rule import TriggerRule
from plant_server.disturbance_signal import disturbance_of
from plant_server.measurement import measurement_model_of

Stack = NDArray[np.float64]


class SampledLoop:
    """The loop of a resolved scenario; every delivered update takes the longest certified delay.

    Raises:
        CallerError: the loop is not linear between events, or the policy is not a rule.
    """

    def __init__(self, resolved: Scenario) -> None:
        coverage, timing = resolved.coverage, resolved.timing
        coverage.require_unchanging()
        coverage.require_certifiable()
        coverage.require_direct_inputs()
        if timing.actuation_timeout_ns <= timing.controller_period_ns + timing.plant_period_ns:
            raise CallerError(
                "plant.watchdog.timeout_s: shorter than the time between two inputs; "
                "give a time after which the watchdog acts on a failure only"
            )
        policy, self.matrices = policy_of(resolved), loop_of(resolved)
        self.resolved, n = resolved, self.matrices.n
        self.last = timing.horizon_ns // timing.plant_period_ns
        self.step_s = timing.plant_period_ns * 1e-9
        self.weight = np.eye(n) if self.matrices.weight is None else self.matrices.weight
        self.delay_ns = network_delay_ns(resolved, 0)
        self._rule = rule_of(policy.trigger_rule(n))
        self._first_auxiliary = policy.initial_dynamic_variable
        self._loop = _loop(resolved, self.matrices, self.delay_ns)
        self._most_in_flight = self.delay_ns // timing.measurement_period_ns + 2
        size = max(n, len(self._loop.C))
        self._own = Scratch(
            np.empty(n), np.empty(size), np.empty(2 * n), np.empty(2), np.empty(4 * n)
        )

    @property
    def known_start(self) -> bool:
        """Whether sensor and controller start from x(0), without a packet."""
        return self.resolved.network.initial_sync == "known_state"

    def start(self) -> Runs:
        """Return one run at its start: after the delivered first packet, if there is one."""
        n, known = self.matrices.n, self.known_start
        runs = self.empty(1)
        x0 = self.matrices.x0
        runs.x[0], runs.auxiliary[0], runs.step[0] = x0, self._first_auxiliary, -1
        if known:
            runs.x_s[0] = runs.x_c[0] = x0
        observer = self.resolved.observer
        if observer is not None:
            given = observer.initial_estimate
            runs.y[0] = (x0 if known else np.zeros(n)) if given is None else np.array(given)
        if not known:
            loop_steps.measure(self._loop, runs, 0, 0, self._own)
            runs.step[0] = 0
            self.update(runs, np.array([True]))
        return runs

    @property
    def every(self) -> int:
        """Steps from one measurement to the next."""
        return self._loop.every

    @property
    def causes(self) -> tuple[Matrix, Matrix]:
        """The changes of x by the disturbance of each step, and the noise of each measurement."""
        return self._loop.push, self._loop.noise

    def with_causes(self, push: Matrix, noise: Matrix) -> "SampledLoop":
        """Return this loop with other disturbances and noise."""
        changed = copy(self)
        changed._loop = self._loop._replace(push=_dense(push), noise=_dense(noise))
        return changed

    def correction(self, numbers: Numbers) -> Stack:
        """Return the change of y by noise at each of k measurements, (k, n, p)."""
        if len(self._loop.gains):
            return self._loop.gains[numbers]
        return np.broadcast_to(np.eye(self.matrices.n), (len(numbers), *[self.matrices.n] * 2))

    def measure_at(self, runs: Runs) -> None:
        """Measure, where the step of a run is one of a measurement; y is 0 before."""
        for i in np.flatnonzero(runs.step % self.every == 0).tolist():
            loop_steps.measure(self._loop, runs, i, int(runs.step[i]) // self.every, self._own)

    def empty(self, count: int) -> Runs:
        """Return runs at 0."""
        n, m, r = self.matrices.n, self.matrices.m, self._most_in_flight
        return Runs(
            np.zeros(count, np.int64), np.zeros((count, n)), np.zeros((count, n)),
            np.zeros((count, n)), np.zeros((count, n)), np.zeros((count, m)),
            np.zeros((count, m)), np.full((count, r), -1.0), np.zeros((count, r, n)),
            np.zeros(count), np.zeros(count, np.bool_), np.zeros(count), np.zeros(count),
            np.zeros(count), np.zeros(count, np.int64), np.zeros(count, np.int64),
        )  # fmt: skip

    def update(self, runs: Runs, delivered: Any) -> None:
        """Make the events of runs: x_s = y, and send the update of the delivered ones, (N,)."""
        runs.x_s[:] = runs.y
        rows = np.flatnonzero(delivered)
        place = (runs.sent[rows] >= 0).sum(axis=1)
        runs.sent[rows, place] = runs.step[rows]
        runs.updates[rows, place] = runs.y[rows]

    def follow(self, runs: Runs, scales: Scales, last: Numbers, *, tests: bool = True) -> None:
        """Advance runs in place to their next events, at most to their steps ``last``, (N,).

        Without ``tests`` there are no events.
        """
        _compiled()(self._loop, self._rule, scales, runs, last, tests, self._own)


@cache
def _compiled() -> Any:
    from cosim.simulation.compiled_runs import compile_kept

    modules = (ordered_arithmetic, trigger_arrays, self_triggered_interval, loop_steps)
    return compile_kept(loop_steps.follow, "sampled", modules)


def rule_of(rule: TriggerRule) -> Rule:
    """Return a trigger rule as numbers."""
    trigger, matrices = np.zeros(1, trigger_arrays.TRIGGER), list[float]()
    trigger_arrays.set_rule(trigger[0], rule, rule.weight, matrices)
    forecast = Forecast(*map(float, rule.forecast or (0.0,) * len(Forecast._fields)))
    return Rule(
        trigger, np.array([*matrices, 0.0]), rule.forecast is not None, forecast,
        float(rule.shortest_ns), float(rule.longest_ns),
    )  # fmt: skip


def _loop(resolved: Scenario, matrices: LoopMatrices, delay_ns: int) -> Loop:
    timing, n, K = resolved.timing, matrices.n, matrices.K
    period_ns, steps = timing.plant_period_ns, timing.horizon_ns // timing.plant_period_ns
    A, B = discretise(matrices.A, matrices.B, period_ns)
    assumed, measurements = assumed_model(resolved), steps // resolved.plant.measure_every + 1
    gains = np.zeros((0, n, len(assumed.C)))
    if resolved.observer is not None:
        gains = np.array(list(islice(resolved.observer.gains(assumed), measurements)))
    tick_ns, phase_ns = timing.controller_period_ns, timing.controller_phase_ns
    step_ns = np.arange(steps + 1) * period_ns
    last_tick_ns = (step_ns + period_ns - 1 - phase_ns) // tick_ns * tick_ns + phase_ns
    ticks = (last_tick_ns >= step_ns) & (last_tick_ns >= phase_ns)
    after_ns, tick = np.unique(last_tick_ns[ticks] - step_ns[ticks], return_inverse=True)
    tick_of = np.full(steps + 1, NO_TICK)
    tick_of[ticks] = tick
    acts = np.searchsorted(np.where(ticks, last_tick_ns, step_ns), step_ns + delay_ns)
    wait = acts - np.arange(steps + 1)
    waits, age = np.unique(wait, return_inverse=True)
    safe = resolved.controller.safe_input
    known = resolved.network.initial_sync == "known_state"
    return Loop(
        period_ns, resolved.plant.measure_every, -1 if known else int(wait[0]), A, B,
        pushes_of(resolved), _dense(assumed.Ad), _dense(assumed.Bd),
        _dense(assumed.C), _dense(gains), noise_of(resolved),
        transition(matrices.H, period_ns), tick_of,
        _dense(np.array([K @ transition(matrices.H, int(s)) for s in after_ns])),
        wait.astype(np.int64), age.astype(np.int64),
        _dense(np.array([transition(matrices.H, int(s) * period_ns) for s in waits])),
        np.zeros(matrices.m) if safe is None else np.array(safe, dtype=np.float64),
    )  # fmt: skip


def through_of(resolved: Scenario) -> Matrix:
    """Return the effect of disturbances of u and of ẋ, held over a step, on x, (n, m + n)."""
    matrices, period_ns = loop_of(resolved), resolved.timing.plant_period_ns
    sources = np.hstack([matrices.B, np.eye(matrices.n)])
    return discretise(matrices.A, sources, period_ns)[1]


def pushes_of(resolved: Scenario) -> Matrix:
    """Return the changes of x by the disturbance of each step, (steps, n); (0, n) for none."""
    disturbance, (n, m) = disturbance_of(resolved), resolved.model.dimensions
    if disturbance is None:
        return np.zeros((0, n))
    through = through_of(resolved)
    found = np.zeros((resolved.timing.horizon_ns // resolved.timing.plant_period_ns, n))
    d, w = disturbance.values(range(len(found)))
    for part, at in ((d, through[:, :m]), (w, through[:, m:])):
        if part.shape[1]:
            found += part @ at.T
    return found


def noise_of(resolved: Scenario) -> Matrix:
    """Return the noise of each measurement, (measurements, p); (0, p) for none."""
    model = measurement_model_of(resolved)
    if model is None or not model.is_noisy:
        return np.zeros((0, resolved.message_sizes.outputs))
    steps = resolved.timing.horizon_ns // resolved.timing.plant_period_ns
    return model.noise(0, steps // resolved.plant.measure_every + 1)


def _dense(matrix: Matrix | Numbers) -> Matrix:
    return np.ascontiguousarray(matrix, dtype=np.float64)

"""Random lossy loops, simulated exactly and many at a time; independent of the project's code.

Every signal is propagated by matrix exponentials on a grid finer than every period of the loop. The
steps are compiled. In the compiled part signals are rows, so all matrices are transposed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hypothesis import HealthCheck, Phase, assume, settings
from hypothesis import strategies as st
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossRule,
)
from noack.plants.systems.code_cache import CALLED_BY_CODE, cache_folder, compiler
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.bounds.terms import Constants, NetworkConditions, NoCertificateError, TriggerBound
from noack.theory.certificates.solution import solve

COMPILED = compiler(cache_folder("tests", [Path(__file__)]))
"""Its lock keeps two processes of the tests from compiling the same."""
PART = njit(**CALLED_BY_CODE)
Reals = NDArray[np.float64]
Flags = NDArray[np.bool_]
Steps = NDArray[np.int64]


class Schedule(NamedTuple):
    """The times of a loop, in steps."""

    known_start: bool
    sample: int
    hold: int
    lag: int


class Propagators(NamedTuple):
    """Matrices over one step; the first index of a plant's is its number in the pool."""

    K: Reals
    """(n, m)"""
    weight: Reals
    both: Reals
    """(plants, 2n, n): x of u = K x_c, from x and x_c."""
    held: Reals
    """(plants, n + m, n): x of a held input, from x and u."""
    free: Reals
    """(plants, n, n): x without an input."""
    pushed: Reals
    """(plants, n, n): x of a constant disturbance of ẋ."""
    model: Reals
    late: Reals
    """(delays, n, n): the models' propagators over the delay of an update."""


class State(NamedTuple):
    """All runs between two steps; the last index is the run."""

    x: Reals
    """(n, runs)"""
    x_s: Reals
    x_c: Reals
    arriving: Reals
    """(slots, n, runs) an update in flight, as its value on arrival."""
    arrives: Steps
    """(slots, runs) number of the update, from 1; 0: none."""
    newest: Steps
    events: Steps
    last_event: Steps
    synchronised: Flags
    commands: Reals
    """(steps, m, runs)"""
    commanded: Flags
    """(steps, runs) whether there is a command."""


class Given(NamedTuple):
    """What does not depend on the state."""

    threshold: Reals
    """(steps,)"""
    delivered: Flags
    """(runs, events)"""
    delays: Steps
    """(runs, events)"""
    plants: Steps
    """(steps, runs) number of the plant in the pool; or (0, 0) for the only one."""
    pushes: Reals
    """(steps, n, runs); or (0, 0, 0) for none."""


class Seen(NamedTuple):
    """The results."""

    trace: Reals
    """(5, steps, runs)"""
    inputs: Reals
    """(steps, m, runs)"""
    shortest: Steps
    """(runs,) the shortest inter-event time in steps."""
    states: Reals
    """(2, steps, n, runs): x, and what the sensor knows of it."""
    is_event: Flags
    """(steps, runs)"""
    received: Steps
    """(steps, runs) number of the newest update that has arrived."""


@PART
def add_product(total: Reals, v: Reals, matrix: Reals, first: int) -> None:
    """Add v M, of the rows of M from ``first`` on; v and the total have shapes (n, runs)."""
    for j in range(total.shape[0]):
        for i in range(v.shape[0]):
            factor = matrix[first + i, j]
            for run in range(v.shape[1]):
                total[j, run] += factor * v[i, run]


@PART
def distances(found: Reals, v: Reals, w: Reals, matrix: Reals) -> None:
    """Set ‖(v − w) M‖, (runs,); v and w have the shapes (n, runs)."""
    rest, found[:] = np.empty_like(found), 0.0
    for j in range(matrix.shape[1]):
        rest[:] = 0.0
        for i in range(v.shape[0]):
            factor = matrix[i, j]
            for run in range(v.shape[1]):
                rest[run] += factor * (v[i, run] - w[i, run])
        for run in range(v.shape[1]):
            found[run] += rest[run] * rest[run]
    for run in range(v.shape[1]):
        found[run] = np.sqrt(found[run])


@COMPILED
def follow(
    first: int, last: int, schedule: Schedule, own: Propagators, given: Given, state: State,
    seen: Seen, known: Reals, event: Flags,
) -> None:  # fmt: skip
    """Simulate the steps first … last − 1 of all runs, in place.

    ``known``, (n, runs), is what the sensor knows of x at the step ``first``; (n, 0): x. ``event``
    says which runs have an event then; (0,): those above the threshold.
    """
    x, x_s, x_c, trace = state.x, state.x_s, state.x_c, seen.trace
    size, everything = np.empty(x.shape[1]), np.eye(len(x))
    nothing, has_input = np.zeros_like(x), np.zeros(x.shape[1], dtype=np.bool_)
    for step in range(first, last):
        estimate = known if step == first and known.size else x
        distances(trace[0, step], x_s, x, own.weight)
        if step % schedule.sample == 0:
            distances(size, x_s, estimate, own.weight)
            for run in range(len(size)):
                trace[0, step, run] = max(trace[0, step, run], size[run])
                goes = event[run] if len(event) else size[run] > given.threshold[step]
                if goes or (step == 0 and not schedule.known_start):
                    _send(run, step, own, given, state, seen, estimate)
        _deliver(step % len(state.arrives), state)
        seen.states[0, step], seen.states[1, step] = x, estimate
        seen.received[step] = state.newest
        _command(step, schedule, own, state)
        u, has_input[:] = seen.inputs[step], False
        if step >= schedule.lag:
            has_input[:] = state.commanded[step - schedule.lag]
            u[:] = state.commands[step - schedule.lag] * has_input
        distances(trace[1, step], x_c, x, own.weight)
        distances(size, x_c, estimate, own.weight)
        trace[1, step] = np.maximum(trace[1, step], size) * state.synchronised
        distances(trace[2, step], x, nothing, everything)
        distances(trace[3, step], x, nothing, own.weight)
        gap = u.copy()
        add_product(gap, x, -own.K, 0)
        trace[4, step] = np.sqrt((gap * gap).sum(axis=0)) * has_input
        _advance(step, schedule, own, given, state, u, has_input)


@PART
def _send(
    run: int, step: int, own: Propagators, given: Given, state: State, seen: Seen, estimate: Reals
) -> None:
    """Let an event happen: x_s is reset, and an update is lost or in flight."""
    number = state.events[run]
    if number > 0:
        seen.shortest[run] = min(seen.shortest[run], step - state.last_event[run])
    state.x_s[:, run] = estimate[:, run]
    state.last_event[run], seen.is_event[step, run] = step, True
    if given.delivered[run, number]:
        delay = given.delays[run, number]
        slot = (step + delay) % len(state.arrives)
        for j in range(len(estimate)):
            value = 0.0
            for i in range(len(estimate)):
                value += estimate[i, run] * own.late[delay, i, j]
            state.arriving[slot, j, run] = value
        state.arrives[slot, run] = number + 1
    state.events[run] = number + 1


@PART
def _deliver(slot: int, state: State) -> None:
    """Let the updates arrive that are due; an older one than the newest is discarded."""
    for run in range(len(state.newest)):
        if state.arrives[slot, run] > state.newest[run]:
            state.x_c[:, run] = state.arriving[slot, :, run]
            state.newest[run] = state.arrives[slot, run]
            state.synchronised[run] = True
        state.arrives[slot, run] = 0


@PART
def _command(step: int, schedule: Schedule, own: Propagators, state: State) -> None:
    """Note the controller's command of this step."""
    if schedule.hold == 0 or step % schedule.hold == 0:
        add_product(state.commands[step], state.x_c, own.K, 0)
        state.commanded[step] = state.synchronised
    else:
        state.commands[step] = state.commands[step - 1]
        state.commanded[step] = state.commanded[step - 1]


@PART
def _advance(
    step: int, schedule: Schedule, own: Propagators, given: Given, state: State, u: Reals,
    has_input: Flags,
) -> None:  # fmt: skip
    """Propagate x, x_s and x_c over one step; u = K x_c changes with x_c unless it is held."""
    x, x_s, x_c = state.x, state.x_s, state.x_c
    n = len(x)
    following = np.zeros_like(x)
    for plant in range(len(own.free)):
        moved = np.zeros_like(x)
        if schedule.hold > 0:
            add_product(moved, x, own.held[plant], 0)
            add_product(moved, u, own.held[plant], n)
        elif has_input.any():
            add_product(moved, x, own.both[plant], 0)
            add_product(moved, x_c, own.both[plant], n)
        if schedule.hold == 0 and not has_input.all():
            free = np.zeros_like(x)
            add_product(free, x, own.free[plant], 0)
            moved = np.where(has_input, moved, free)
        if len(given.pushes):
            add_product(moved, given.pushes[step], own.pushed[plant], 0)
        if len(own.free) == 1:
            following = moved
        else:
            following += np.where(given.plants[step] == plant, moved, 0.0)
    x[:] = following
    for models in (x_s, x_c):
        moved = np.zeros_like(x)
        add_product(moved, models, own.model, 0)
        models[:] = moved


@COMPILED
def allow(lost: Flags, mansd: int, most: int, width: int, recovery: int) -> None:
    """Deliver what the guarantee does not allow to be lost, (runs, events), in place."""
    for run in range(lost.shape[0]):
        burst, since = 0, recovery
        for event in range(lost.shape[1]):
            if lost[run, event]:
                recent = lost[run, max(event - width + 1, 0) : event].sum()
                if burst >= mansd or recent >= most or (burst == 0 and since < recovery):
                    lost[run, event] = False
            if lost[run, event]:
                burst, since = burst + 1, 0
            else:
                burst, since = 0, since + 1


RUNS, STEPS = 128, 240

ROUNDING = 1 + 1e-9
"""Simulation and enclosure are both rounded; each error is below this."""

SEARCH = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])

seeds = st.integers(0, 2**32)


@dataclass(frozen=True)
class System:
    """A loop with model mismatch, its trigger, and its schedule in steps of a fine grid."""

    A: Matrix
    B: Matrix
    K: Matrix
    H: Matrix
    weight: Matrix
    x0: Vector
    alpha: float
    beta: float
    known_start: bool
    mansd: int
    step_s: float
    sample_steps: int
    """Steps between two tests of the trigger."""
    delay_steps: int
    """Maximum delay of an update in steps."""
    hold_steps: int
    """Steps between two inputs; 0: the plant applies K x_c continuously."""
    lag_steps: int
    """Delay of an input in steps."""
    window: tuple[int, int] = (1, 1)
    """(m, K): at most m losses in K consecutive updates, if m < K."""
    recovery: int = 0
    """Least number of deliveries between two bursts of losses."""

    @property
    def conditions(self) -> NetworkConditions:
        """The conditions of :func:`simulate` that the certificate may assume."""
        applied_input = self.delay_steps
        applied_input += self.hold_steps - 1 + self.lag if self.hold_steps else 0
        sampling_s = self.sample_steps * self.step_s
        return NetworkConditions(
            dropouts=self.guarantee.longest_burst,
            constraints=self.guarantee.rules[1:],
            sampling_s=sampling_s,
            spacing_s=sampling_s,
            delay_s=applied_input * self.step_s,
            hold_s=(self.hold_steps + self.lag) * self.step_s,
            start_s=applied_input * self.step_s,
        )

    @property
    def events(self) -> int:
        """More than the number of tests in a run."""
        return STEPS // self.sample_steps + 2

    @property
    def guarantee(self) -> LossGuarantee:
        """The rules of the network's losses."""
        rules: list[LossRule] = [LongestBurst(self.mansd)]
        rules += [LossesInWindow(*self.window)] if self.window[0] < self.window[1] else []
        rules += [DeliveriesBetweenBursts(self.recovery)] if self.recovery else []
        return LossGuarantee(tuple(rules))

    @property
    def lag(self) -> int:
        return self.lag_steps if self.hold_steps else 0

    def gains(
        self, error: type[ErrorGains] = ErrorGains, plant: type[PlantGains] = PlantGains
    ) -> PlantGains:
        models = error(self.H, self.K, self.weight, self.alpha)
        return plant(models, self.A, self.B, self.x0[:, None], self.alpha)

    def certify(
        self,
        conditions: NetworkConditions | None = None,
        plant: PlantGains | None = None,
        *,
        structured: bool = True,
    ) -> Constants:
        plant, level = plant or self.gains(), TriggerBound(self.beta, self.beta)
        conditions = conditions or self.conditions
        return solve(plant.error, plant, conditions, level, structured=structured)


def certified_or_skipped(
    system: System, conditions: NetworkConditions | None = None, *, structured: bool = True
) -> Constants:
    try:
        return system.certify(conditions, structured=structured)
    except NoCertificateError:
        assume(False)
        raise


def assert_not_smaller(larger: Constants, smaller: Constants, system: System) -> None:
    """δ is searched with a relative accuracy of 0.1 % and enclosed with 1 %."""
    for name in ("delta", "overshoot", "input_error", "state", "mismatch"):
        assert getattr(smaller, name) <= getattr(larger, name) * 1.01, name
    longest_s = 5 / system.alpha  # beyond all other times of the loop, δ is as coarse as its grid
    least_s = min(larger.inter_event_s or 0.0, longest_s)
    assert (smaller.inter_event_s or 0.0) >= least_s * 0.98


class Trace(NamedTuple):
    """Norms of signals in every run and step, (runs, STEPS), and the shortest inter-event time."""

    sensor_error: Reals
    """‖e_s‖_W before a reset."""
    controller_error: Reals
    state: Reals
    state_weighted: Reals
    input_error: Reals
    inter_event_s: float
    x: Reals
    """(runs, STEPS, n)"""
    known: Reals
    """What the sensor knows of x, (runs, STEPS, n)."""
    is_event: Flags
    received: Steps
    """Number of the newest update that the controller has received, from 1 on; 0 for none."""

    def shares(self, system: System, certified: Constants) -> dict[str, Reals]:
        """Each signal divided by its bound, (runs, STEPS) or a number; at most 1 if it holds."""
        growth, beta = np.exp(system.alpha * times_s(system)), system.beta
        assert certified.inter_event_s is not None
        return {
            "sensor error": growth * self.sensor_error / (certified.overshoot * beta),
            "controller error": growth * self.controller_error / (certified.delta * beta),
            "state": growth * self.state / certified.state,
            "weighted state": growth * self.state_weighted / certified.state_weighted,
            "input error": growth * self.input_error / certified.input_error,
            "inter-event time": np.array(certified.inter_event_s / self.inter_event_s),
        }

    def exceeded(self, system: System, certified: Constants) -> list[str]:
        """The bounds that some run exceeds."""
        shares = self.shares(system, certified)
        return [name for name, share in shares.items() if share.max() > ROUNDING]


def times_s(system: System) -> Reals:
    """Times of the steps, (STEPS,)."""
    return np.arange(STEPS) * system.step_s


EventRule = Callable[[int, Steps, Reals, Reals], Flags]
"""Which runs have an event at a test, from the step, the steps since each last event, x and e_s."""


class Plants(NamedTuple):
    """Plants between which each run switches arbitrarily."""

    pool: list[tuple[Matrix, Matrix]]
    """(A, B) of each."""
    which: NDArray[np.int64]
    """(runs, STEPS) the index of each run's plant in each step."""


Estimate = Callable[[int, Reals, list[Reals]], Reals]
"""Returns x̂ at a step, from x and the inputs since the last test, (runs, n) and (runs, m)."""


def exact_state(step: int, x: Reals, inputs: list[Reals]) -> Reals:
    """A sensor that measures x."""
    return x


def simulate(
    system: System,
    delivered: Flags,
    delays: NDArray[np.int64],
    *,
    floor: float = 0.0,
    plants: Plants | None = None,
    pushes: Reals | None = None,
    estimate: Estimate = exact_state,
    rule: "EventRule | None" = None,
) -> Trace:
    """Simulate all runs at once.

    Args:
        system: the loop.
        delivered: (runs, events) whether the network delivers the update.
        delays: (runs, events) delay of each update in steps.
        floor: floor of the trigger's threshold.
        plants: replace the system's own plant.
        pushes: (runs, STEPS, n) disturbances that are added to ẋ, constant in each step.
        estimate: what the sensor knows of x; errors are the larger of those to it and to x.
        rule: replaces the decaying threshold.
    """
    runs, (n, m) = len(delivered), system.B.shape
    pool = [(system.A, system.B)] if plants is None else plants.pool
    given = Given(
        np.maximum(system.beta * np.exp(-system.alpha * times_s(system)), floor),
        delivered, delays,
        np.zeros((0, 0), dtype=np.int64) if plants is None else plants.which.T.copy(),
        np.zeros((0, 0, 0)) if pushes is None else pushes.transpose(1, 2, 0).copy(),
    )  # fmt: skip
    state, own = _start(system, runs), _propagators(system, pool)
    schedule = Schedule(
        system.known_start, system.sample_steps, system.hold_steps, system.lag
    )  # fmt: skip
    seen = Seen(
        np.zeros((5, STEPS, runs)), np.zeros((STEPS, m, runs)), np.full(runs, 10**9),
        np.zeros((2, STEPS, n, runs)), np.zeros((STEPS, runs), dtype=bool),
        np.zeros((STEPS, runs), dtype=np.int64),
    )  # fmt: skip
    # What is called here is called at every test; otherwise all steps are compiled.
    every = system.sample_steps if rule or estimate is not exact_state else STEPS
    for step in range(0, STEPS, every):
        known, event, x = np.zeros((n, 0)), np.zeros(0, dtype=bool), state.x.T
        if estimate is not exact_state:
            inputs = seen.inputs[max(step - every, 0) : step].transpose(0, 2, 1)
            known = estimate(step, x, list(inputs)).T.copy()
        if rule is not None:
            event = rule(step, step - state.last_event, x, state.x_s.T - x)
        last = min(step + every, STEPS)
        follow(step, last, schedule, own, given, state, seen, known, event)
    shortest_s = int(seen.shortest.min()) * system.step_s
    return Trace(
        *seen.trace.transpose(0, 2, 1), shortest_s, *seen.states.transpose(0, 3, 1, 2),
        seen.is_event.T, seen.received.T,
    )  # fmt: skip


def norms(rows: Reals) -> Reals:
    return np.sqrt(np.einsum("ij,ij->i", rows, rows))


def _start(system: System, runs: int) -> State:
    n, m = system.B.shape
    x, none = np.tile(system.x0[:, None], runs), np.zeros(runs, dtype=np.int64)
    slots = system.delay_steps + 1
    return State(
        x, x.copy(), x.copy() if system.known_start else np.zeros_like(x),
        np.zeros((slots, n, runs)), np.zeros((slots, runs), dtype=np.int64),
        none, none.copy(), none.copy(), np.full(runs, system.known_start),
        np.zeros((STEPS, m, runs)), np.zeros((STEPS, runs), dtype=bool),
    )  # fmt: skip


def _propagators(system: System, pool: list[tuple[Matrix, Matrix]]) -> Propagators:
    """Propagators over one step, for the system or for the plants between which it switches."""
    (n, m), step_s = system.B.shape, system.step_s
    both, held = np.zeros((len(pool), 2 * n, 2 * n)), np.zeros((len(pool), n + m, n + m))
    pushed = np.zeros((len(pool), 2 * n, 2 * n))
    for i, (A, B) in enumerate(pool):
        both[i, :n, :n], both[i, :n, n:], both[i, n:, n:] = A, B @ system.K, system.H
        held[i, :n, :n], held[i, :n, n:] = A, B
        pushed[i, :n, :n], pushed[i, :n, n:] = A, np.eye(n)

    def propagated(generators: Matrix, columns: slice) -> Matrix:
        return np.ascontiguousarray(expm(generators * step_s)[:, :n, columns].transpose(0, 2, 1))

    everything = slice(None)
    late = np.array([k * system.H for k in range(system.delay_steps + 1)])
    return Propagators(
        np.ascontiguousarray(system.K.T), np.ascontiguousarray(system.weight.T),
        propagated(both, everything), propagated(held, everything),
        propagated(both[:, :n, :n], everything), propagated(pushed, slice(n, None)),
        np.ascontiguousarray(expm(system.H * step_s).T), propagated(late, everything),
    )  # fmt: skip


def networks(seed: int, system: System) -> tuple[Flags, NDArray[np.int64]]:
    """Loss patterns that the guarantee allows: worst cases, and random ones."""
    rng = np.random.default_rng(seed)
    lost = rng.uniform(size=(RUNS, system.events)) < rng.uniform(size=(RUNS, 1)) ** 0.5
    lost[0] = True
    lost[1] = False
    delays = rng.integers(0, system.delay_steps + 1, lost.shape)
    delays[:4] = system.delay_steps
    return ~allowed(lost, system), delays


def allowed(lost: Flags, system: System) -> Flags:
    """The losses (runs, events) without those that the guarantee does not allow."""
    lost = lost.copy()
    if not system.known_start:
        lost[:, 0] = False
    most, width = system.window if system.window[0] < system.window[1] else (1, 1)
    allow(lost, system.mansd, most, width, system.recovery)
    return lost


def systems(**fixed: Any) -> st.SearchStrategy[System]:
    """Loops of every kind; ``fixed`` replaces some of the drawn values."""
    return seeds.map(lambda seed: random_system(np.random.default_rng(seed), **fixed))


def random_system(rng: np.random.Generator, **fixed: Any) -> System:
    """A loop of any kind; ``fixed`` replaces some of the drawn values."""

    def choose(name: str, values: Sequence[Any]) -> Any:
        return fixed.get(name, values[rng.integers(len(values))])

    n, m = choose("n", range(1, 6)), choose("m", (1, 2))
    H = rng.uniform(-1, 1, (n, n)) * choose("spread", (1.0, 3.0))
    H -= (spectral_abscissa(H) + rng.uniform(0.5, 2.0)) * np.eye(n)
    B_model, K = rng.uniform(-1, 1, (n, m)), rng.uniform(-1, 1, (m, n))
    alpha = choose("alpha_share", (0.2, 0.5, 0.8)) * -spectral_abscissa(H)
    change_A, change_B = rng.uniform(-1, 1, (n, n)), rng.uniform(-1, 1, (n, m))
    mismatch = choose("mismatch", (0.0, 0.1, 0.5))
    while spectral_abscissa(H + mismatch * (change_A + change_B @ K)) >= -alpha:
        mismatch /= 2
    weighted = choose("weighted", (False, True))
    weight = rng.uniform(-1, 1, (n, n)) + 1.5 * np.eye(n) if weighted else np.eye(n)
    speed = float(np.abs(np.linalg.eigvals(H)).max())
    return System(
        A=H - B_model @ K + mismatch * change_A,
        B=B_model + mismatch * change_B,
        K=K,
        H=H,
        weight=weight,
        x0=rng.uniform(-1, 1, n),
        alpha=alpha,
        beta=choose("beta", (0.01, 0.05, 0.3, 1.0)),
        known_start=choose("known_start", (False, True)),
        mansd=choose("mansd", range(7)),
        step_s=choose("step_share", (0.002, 0.01, 0.03)) / speed,
        sample_steps=choose("sample_steps", range(1, 5)),
        delay_steps=choose("delay_steps", range(5)),
        hold_steps=choose("hold_steps", range(5)),
        lag_steps=choose("lag_steps", range(3)),
        window=choose("window", ((1, 1), (1, 4), (2, 5), (3, 12), (4, 40))),
        recovery=choose("recovery", (0, 0, 2, 6)),
    )

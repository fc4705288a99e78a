"""Random lossy loops, simulated exactly and many at a time; independent of the project's code.

Every signal is propagated by matrix exponentials on a grid finer than every period of the loop.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from hypothesis import HealthCheck, Phase, assume, settings
from hypothesis import strategies as st
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
from noack.theory.bounds.certificate_terms import (
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.solution import solve

Reals = NDArray[np.float64]
Flags = NDArray[np.bool_]
Steps = NDArray[np.int64]

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

    def gains(self, error: type[ErrorGains] = ErrorGains, plant: type[PlantGains] = PlantGains) -> PlantGains:
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
"""Which runs have an event at a test, from the step, the steps since each last event, x and e_s.

With an observer both are those to the estimate.
"""


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
    runs, (n, m), K, W = len(delivered), system.B.shape, system.K.T, system.weight.T
    pool = [(system.A, system.B)] if plants is None else plants.pool
    steps = [_Propagators(system, A, B) for A, B in pool]
    threshold = np.maximum(system.beta * np.exp(-system.alpha * times_s(system)), floor)
    x = np.tile(system.x0, (runs, 1))
    x_s, x_c = x.copy(), x.copy() if system.known_start else np.zeros_like(x)
    # An update in flight is its value on arrival; 0 in ``arrives``: no update.
    slots, every = system.delay_steps + 1, np.arange(runs)
    arriving, arrives = np.zeros((slots, runs, n)), np.zeros((slots, runs), dtype=np.int64)
    newest, events, last_event = (np.zeros(runs, dtype=np.int64) for _ in range(3))
    synchronised = np.full(runs, system.known_start)
    commands: list[tuple[Reals, Flags]] = []
    inputs = np.zeros((STEPS, runs, m))
    xs, x_ss, x_cs = (np.empty((STEPS, runs, n)) for _ in range(3))
    knowns = xs if estimate is exact_state else np.empty_like(xs)
    is_event, has_input, has_state = (np.zeros((STEPS, runs), bool) for _ in range(3))
    received = np.zeros((STEPS, runs), dtype=np.int64)
    for step in range(STEPS):
        x_ss[step], known = x_s, x
        if step % system.sample_steps == 0:
            since = max(step - system.sample_steps, 0)
            known = estimate(step, x, list(inputs[since:step]))
            if rule is None:
                event = norms((x_s - known) @ W) > threshold[step]
            else:
                event = rule(step, step - last_event, known, x_s - known)
            event = event | (step == 0 and not system.known_start)
            x_s, last_event = (
                np.where(event[:, None], known, x_s),
                np.where(event, step, last_event),
            )
            sent = np.flatnonzero(event & delivered[every, events])
            delay = delays[sent, events[sent]]
            slot = (step + delay) % slots
            arriving[slot, sent] = np.einsum("ri,rij->rj", known[sent], steps[0].late[delay])
            arrives[slot, sent] = events[sent] + 1
            events, is_event[step] = events + event, event
        now = step % slots
        fresh = arrives[now] > newest
        x_c = np.where(fresh[:, None], arriving[now], x_c)
        newest, arrives[now] = np.where(fresh, arrives[now], newest), 0
        synchronised = synchronised | fresh
        is_new = system.hold_steps == 0 or step % system.hold_steps == 0
        commands.append((x_c @ K, synchronised) if is_new else commands[-1])
        if step >= system.lag:
            u, has_input[step] = commands[step - system.lag]
            inputs[step] = u * has_input[step][:, None]
        xs[step], knowns[step], x_cs[step] = x, known, x_c
        has_state[step], received[step] = synchronised, newest
        push = None if pushes is None else pushes[:, step]
        following = [one.advance(x, x_c, inputs[step], has_input[step], push) for one in steps]
        x = following[0] if plants is None else np.array(following)[plants.which[:, step], every]
        x_s, x_c = x_s @ steps[0].model, x_c @ steps[0].model

    def errors(estimates: Reals) -> Reals:
        to_x = norms((estimates - xs) @ W)
        return to_x if knowns is xs else np.maximum(to_x, norms((estimates - knowns) @ W))

    seen = (
        errors(x_ss), errors(x_cs) * has_state, norms(xs), norms(xs @ W),
        norms(inputs - xs @ K) * has_input,
    )  # fmt: skip
    event_run, event_step = np.nonzero(is_event.T)
    shortest = np.diff(event_step)[np.diff(event_run) == 0].min(initial=10**9)
    return Trace(
        *(one.T for one in seen), float(shortest * system.step_s),
        xs.transpose(1, 0, 2), knowns.transpose(1, 0, 2), is_event.T, received.T,
    )  # fmt: skip


def norms(rows: Reals) -> Reals:
    """The norms of vectors along the last axis."""
    return np.asarray(np.sqrt(np.einsum("...j,...j->...", rows, rows)))


class _Propagators:
    """Matrices over one step, transposed, as states are rows."""

    def __init__(self, system: System, A: Matrix, B: Matrix) -> None:
        (n, m), step_s = B.shape, system.step_s
        both, held, pushed = (np.zeros((n + k, n + k)) for k in (n, m, n))
        both[:n], both[n:, n:] = np.hstack([A, B @ system.K]), system.H
        held[:n], pushed[:n] = np.hstack([A, B]), np.hstack([A, np.eye(n)])
        self.is_held = system.hold_steps > 0
        self.both, self.held = expm(both * step_s).T[:, :n], expm(held * step_s).T[:, :n]
        self.free, self.model = expm(A * step_s).T, expm(system.H * step_s).T
        self.pushed = expm(pushed * step_s)[:n, n:].T
        self.late = np.array([expm(system.H * step_s * k).T for k in range(system.delay_steps + 1)])

    def advance(self, x: Reals, x_c: Reals, u: Reals, has_input: Flags, push: Any) -> Reals:
        """x of all runs one step later; u = K x_c changes with x_c unless it is held."""
        if self.is_held:
            following = np.concatenate([x, u], axis=1) @ self.held
        else:
            following = np.concatenate([x, x_c], axis=1) @ self.both
            following = np.where(has_input[:, None], following, x @ self.free)
        return following if push is None else following + push @ self.pushed


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
    runs, events = lost.shape
    lost = lost.T.copy()  # what happens to one event in all runs is a row
    if not system.known_start:
        lost[0] = False
    burst, since = np.zeros(runs, dtype=np.int64), np.full(runs, system.recovery)
    most, width = system.window
    for event in range(events):
        lost[event] &= burst < system.mansd
        if most < width:
            lost[event] &= lost[max(event - width + 1, 0) : event].sum(axis=0) < most
        if system.recovery:
            lost[event] &= (burst > 0) | (since >= system.recovery)
            since = np.where(lost[event], 0, since + 1)
        burst = np.where(lost[event], burst + 1, 0)
    return lost.T


def systems(**fixed: Any) -> st.SearchStrategy[System]:
    """Loops of every kind; ``fixed`` replaces some of the drawn values."""
    return seeds.map(lambda seed: random_system(np.random.default_rng(seed), **fixed))


DRIFTING = {"n": 1, "m": 1, "alpha_share": 0.2, "drifts": 1.5}
"""One state that decays more slowly than its model, so e_s grows in one direction: near many bounds."""


def random_system(rng: np.random.Generator, **fixed: Any) -> System:
    """A loop of any kind; ``fixed`` replaces some of the drawn values.

    A quarter of the loops have neither a delay nor a held input: their certificates follow from
    more than those of the others.
    """

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
    A, B = H - B_model @ K + mismatch * change_A, B_model + mismatch * change_B
    return System(
        A=-fixed["drifts"] * alpha * np.eye(n) - B @ K if "drifts" in fixed else A,
        B=B,
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
        delay_steps=choose("delay_steps", (0, 0, 0, 0, 1, 2, 3, 4)),
        hold_steps=choose("hold_steps", (0, 0, 0, 0, 1, 2, 3, 4)),
        lag_steps=choose("lag_steps", range(3)),
        window=choose("window", ((1, 1), (1, 4), (2, 5), (3, 12), (4, 40))),
        recovery=choose("recovery", (0, 0, 2, 6)),
    )

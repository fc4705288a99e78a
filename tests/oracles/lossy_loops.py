"""Random lossy loops, simulated exactly and many at a time; independent of the project's code.

Every signal is propagated by matrix exponentials on a grid finer than every period of the loop.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]
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
    def events(self) -> int:
        """More than the number of tests in a run."""
        return STEPS // self.sample_steps + 2

    @property
    def lag(self) -> int:
        """Delay of an input in steps; 0 if the plant applies K x_c continuously."""
        return self.lag_steps if self.hold_steps else 0


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
    plant_index: NDArray[np.int64]
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
    loops = _Loops(system, len(delivered), plants, estimate is exact_state)
    threshold = np.maximum(system.beta * np.exp(-system.alpha * times_s(system)), floor)
    for step in range(STEPS):
        loops.x_ss[step], known = loops.x_s, loops.x
        if step % system.sample_steps == 0:
            since = max(step - system.sample_steps, 0)
            known = estimate(step, loops.x, list(loops.inputs[since:step]))
            if rule is None:
                event = norms((loops.x_s - known) @ system.weight.T) > threshold[step]
            else:
                event = rule(step, step - loops.last_event, known, loops.x_s - known)
            event = event | (step == 0 and not system.known_start)
            loops.transmit(step, known, event, delivered, delays)
        loops.receive(step)
        loops.apply_inputs(step)
        loops.knowns[step] = known
        loops.advance(step, None if pushes is None else pushes[:, step])
    return loops.trace()


class _Loops:
    """The state of all runs at a step, and their trace; a run is a row of each array."""

    def __init__(self, system: System, runs: int, plants: Plants | None, is_exact: bool) -> None:
        n, m = system.B.shape
        self.system, self.plants, self.every = system, plants, np.arange(runs)
        pool = [(system.A, system.B)] if plants is None else plants.pool
        self.propagators = [_Propagators(system, A, B) for A, B in pool]
        self.x = np.tile(system.x0, (runs, 1))
        self.x_s = self.x.copy()
        self.x_c = self.x.copy() if system.known_start else np.zeros_like(self.x)
        # An update in flight is its value on arrival; 0 in ``arrives``: no update.
        self.slots = system.delay_steps + 1
        self.arriving = np.zeros((self.slots, runs, n))
        self.arrives = np.zeros((self.slots, runs), dtype=np.int64)
        self.newest, self.events, self.last_event = (np.zeros(runs, dtype=np.int64) for _ in range(3))
        self.synchronised = np.full(runs, system.known_start)
        self.commands: list[tuple[Reals, Flags]] = []
        # The trace, (STEPS, runs, ...)
        self.inputs = np.zeros((STEPS, runs, m))
        self.xs, self.x_ss, self.x_cs = (np.empty((STEPS, runs, n)) for _ in range(3))
        self.knowns = self.xs if is_exact else np.empty_like(self.xs)
        self.is_event, self.has_input, self.has_state = (np.zeros((STEPS, runs), bool) for _ in range(3))
        self.received = np.zeros((STEPS, runs), dtype=np.int64)

    def transmit(
        self, step: int, known: Reals, event: Flags, delivered: Flags, delays: NDArray[np.int64]
    ) -> None:
        """Reset x_s where there is an event, and send the updates that are delivered."""
        self.x_s = np.where(event[:, None], known, self.x_s)
        self.last_event = np.where(event, step, self.last_event)
        sent = np.flatnonzero(event & delivered[self.every, self.events])
        delay = delays[sent, self.events[sent]]
        slot = (step + delay) % self.slots
        self.arriving[slot, sent] = np.einsum("ri,rij->rj", known[sent], self.propagators[0].late[delay])
        self.arrives[slot, sent] = self.events[sent] + 1
        self.events, self.is_event[step] = self.events + event, event

    def receive(self, step: int) -> None:
        """Reset x_c where an update arrives that is newer than the last one."""
        now = step % self.slots
        fresh = self.arrives[now] > self.newest
        self.x_c = np.where(fresh[:, None], self.arriving[now], self.x_c)
        self.newest, self.arrives[now] = np.where(fresh, self.arrives[now], self.newest), 0
        self.synchronised = self.synchronised | fresh
        self.has_state[step], self.received[step] = self.synchronised, self.newest

    def apply_inputs(self, step: int) -> None:
        """Compute u = K x_c, or hold it; it reaches the plant after the lag."""
        system = self.system
        is_new = system.hold_steps == 0 or step % system.hold_steps == 0
        self.commands.append((self.x_c @ system.K.T, self.synchronised) if is_new else self.commands[-1])
        if step >= system.lag:
            u, self.has_input[step] = self.commands[step - system.lag]
            self.inputs[step] = u * self.has_input[step][:, None]

    def advance(self, step: int, push: Reals | None) -> None:
        """Note the states, and propagate them over the step."""
        self.xs[step], self.x_cs[step] = self.x, self.x_c
        following = [
            propagator.advance(self.x, self.x_c, self.inputs[step], self.has_input[step], push)
            for propagator in self.propagators
        ]
        if self.plants is None:
            self.x = following[0]
        else:
            self.x = np.array(following)[self.plants.plant_index[:, step], self.every]
        model = self.propagators[0].model
        self.x_s, self.x_c = self.x_s @ model, self.x_c @ model

    def trace(self) -> Trace:
        """The norms of the errors and signals."""
        K, W, xs = self.system.K.T, self.system.weight.T, self.xs
        event_run, event_step = np.nonzero(self.is_event.T)
        shortest = np.diff(event_step)[np.diff(event_run) == 0].min(initial=10**9)
        return Trace(
            self._errors(self.x_ss).T,
            (self._errors(self.x_cs) * self.has_state).T,
            norms(xs).T,
            norms(xs @ W).T,
            (norms(self.inputs - xs @ K) * self.has_input).T,
            float(shortest * self.system.step_s),
            xs.transpose(1, 0, 2),
            self.knowns.transpose(1, 0, 2),
            self.is_event.T,
            self.received.T,
        )

    def _errors(self, estimates: Reals) -> Reals:
        """The larger of the errors to x and to what the sensor knows of it, (STEPS, runs)."""
        W = self.system.weight.T
        to_x = norms((estimates - self.xs) @ W)
        return to_x if self.knowns is self.xs else np.maximum(to_x, norms((estimates - self.knowns) @ W))


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


def spectral_abscissa(matrix: Matrix) -> float:
    """The largest real part of the eigenvalues."""
    return float(np.linalg.eigvals(matrix).real.max())


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

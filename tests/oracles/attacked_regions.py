"""Plants with equations in lossy loops under attack, many runs at a time.

Independent of noack's simulators and of :mod:`tests.checker.runs`, whose steps are exact and need linear
plants: here the classical Runge-Kutta method integrates x, and x_s and x_c follow the model. A run meets the
conditions of a loop and no more: tests every h, updates that take up to d, inputs up to σ old, no input
before t_a, and losses that an attacker chooses up to the longest burst. Where a loop is tested at all times
a run is tested at each step: its events are up to a step late.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from flint import arb
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.proof.elaborate.loop import Loop
from noack.theory.certificates.proven_bounds import ProvenBounds
from tests.checker.runs import floats

Reals = NDArray[np.float64]
Field = Callable[[Reals, Reals], Reals]
SCENARIOS = Path(__file__).parents[2] / "scenarios"


def pendulum(x: Reals, u: Reals) -> Reals:
    """Torque on an inverted pendulum."""
    return np.stack([x[1], 9.81 * np.sin(x[0]) - 0.1 * x[1] + u[0]])


def largest_sizes(
    loop: Loop, field: Field, *, step_s: float, steps: int, runs: int, seed: int = 0
) -> dict[str, Reals]:
    """Return the largest size of each output over all runs, (steps,); NaN counts as infinite.

    Args:
        loop: the loop.
        field: ẋ of states and inputs, (n, runs) and (m, runs).
        step_s: time between two steps, of which there is a test at each.
        steps: the number of steps.
        runs: the number of runs.
        seed: of what the attackers draw.
    """
    loops = _AttackedLoops(loop, field, step_s, runs, np.random.default_rng(seed))
    n, m = loops.x.shape[0], len(loops.gain)
    names = ("x", "e_s", "e_c", *(f"x[{i}]" for i in range(n)), *(f"u[{j}]" for j in range(m)))
    found = {name: np.zeros(steps) for name in names}

    def note(name: str, number: int, sizes: Reals) -> None:
        most = np.max(sizes, initial=0.0)
        found[name][number] = np.inf if np.isnan(most) else most

    for number in range(steps):
        note("e_s", number, loops.error_of(loops.x_s))
        loops.transmit(number, loops.events(number))
        loops.receive(number)
        u = loops.inputs()
        note("x", number, np.linalg.norm(loops.x, axis=0))
        note("e_c", number, loops.error_of(loops.x_c)[loops.newest > 0])
        for k, row in enumerate(np.abs(loops.x)):
            note(f"x[{k}]", number, row)
        for k, row in enumerate(np.abs(u)):
            note(f"u[{k}]", number, row)
        loops.advance(u)
    return found


def largest_shares(sizes: dict[str, Reals], bounds: ProvenBounds, step_s: float) -> dict[str, float]:
    """Return the largest share of each proven bound that some sizes reach."""
    return {
        name: float((size / bounds.at(name, np.arange(len(size)) * step_s)).max())
        for name, size in sizes.items()
        if name in bounds.bounds
    }


class _AttackedLoops:
    """The states of all runs, (n, runs), and their attackers.

    An attacker loses updates at random, or in bursts of the greatest length. Its delays, and the
    ages of the inputs, are random, or always the longest.
    """

    def __init__(self, loop: Loop, field: Field, step_s: float, runs: int, rng: np.random.Generator) -> None:
        self.field, self.h, self.runs, self.rng, self.losses = field, step_s, runs, rng, loop.losses
        self.level, self.rate, self.floor = (
            float(v.mid()) for v in (loop.rule.level, loop.rule.rate, loop.rule.floor)
        )
        self.gain, self.weight, H = floats(loop.gain), floats(loop.weight), floats(loop.H)
        sampling_s, delay_s, age_s, start_s = (float(arb(loop.times[k]).mid()) for k in (0, 2, 3, 4))
        self.longest, self.first = (int(time_s / step_s + 1e-9) for time_s in (delay_s, start_s))
        ages = np.linspace(0, max(age_s - sampling_s, 0.0), 4)
        self.is_held = age_s > 0
        # What e^{Ht} makes of x_s and x_c in a step, of a late update, and of K for an old input.
        self.half_step, self.model_step = expm(H * step_s / 2), expm(H * step_s)
        self.late = np.array([expm(H * step_s * steps) for steps in range(self.longest + 1)])
        self.aged_gains = np.array([self.gain @ expm(-H * age) for age in ages])
        self.x = np.tile(floats(loop.start), runs)
        self.x_s, self.x_c = self.x.copy(), np.zeros_like(self.x)
        self.loss_rates = rng.choice([0.3, 0.6, 0.9, 1.0], runs)
        self.always_longest = rng.random(runs) < 0.5
        self.consecutive_losses, self.sent, self.newest = (np.zeros(runs, int) for _ in range(3))
        # By the step of its arrival: the state of an update, and its number; 0: no update.
        self.arriving = np.zeros((self.longest + 1, loop.n, runs))
        self.arrives = np.zeros((self.longest + 1, runs), int)

    def error_of(self, estimates: Reals) -> Reals:
        """‖e‖_W of each run."""
        return np.asarray(np.linalg.norm(self.weight @ (estimates - self.x), axis=0))

    def events(self, number: int) -> NDArray[np.bool_]:
        """Test the trigger; the first test is an event."""
        if not number:
            return np.ones(self.runs, bool)
        threshold = max(self.level * np.exp(-self.rate * number * self.h), self.floor)
        return np.asarray(self.error_of(self.x_s) > threshold)

    def transmit(self, number: int, event: NDArray[np.bool_]) -> None:
        """Reset x_s at events; the attacker loses an update, or delays it."""
        wants_loss = self.rng.random(self.runs) < self.loss_rates
        lost = event & wants_loss & (self.consecutive_losses < self.losses) & (number > 0)
        losses = np.where(lost, self.consecutive_losses + 1, 0)
        self.consecutive_losses = np.where(event, losses, self.consecutive_losses)
        self.sent = self.sent + event
        self.x_s = np.where(event, self.x, self.x_s)
        random_delay = self.rng.integers(0, self.longest + 1, self.runs)
        delay = np.where(self.always_longest, self.longest, random_delay)
        arrival = (number + (delay if number else np.minimum(delay, self.first))) % (self.longest + 1)
        delivered = np.flatnonzero(event & ~lost)
        updates = np.einsum("rij,jr->ri", self.late[delay[delivered]], self.x[:, delivered])
        self.arriving[arrival[delivered], :, delivered] = updates
        self.arrives[arrival[delivered], delivered] = self.sent[delivered]

    def receive(self, number: int) -> None:
        """Reset x_c where an update arrives that is newer than the last one."""
        now = number % (self.longest + 1)
        arrived = self.arrives[now] > self.newest
        self.x_c = np.where(arrived, self.arriving[now], self.x_c)
        self.newest = np.where(arrived, self.arrives[now], self.newest)
        self.arrives[now] = 0

    def inputs(self) -> Reals:
        """The inputs that the plants apply, (m, runs); 0 before the first update."""
        random_age = self.rng.integers(0, len(self.aged_gains), self.runs)
        age = np.where(self.always_longest, len(self.aged_gains) - 1, random_age)
        u = np.einsum("rmn,nr->mr", self.aged_gains[age], self.x_c)
        return np.where(self.newest > 0, u, 0.0)

    def advance(self, u: Reals) -> None:
        """Integrate the plants over a step by the classical Runge-Kutta method, and the models.

        An input is held, unless none may be old.
        """
        x, h, f = self.x, self.h, self.field
        middle, end = u, u
        if not self.is_held:
            middle, end = (self.gain @ M @ self.x_c for M in (self.half_step, self.model_step))
        k1 = f(x, u)
        k2 = f(x + h / 2 * k1, middle)
        k3 = f(x + h / 2 * k2, middle)
        self.x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3, end))
        self.x_s, self.x_c = self.model_step @ self.x_s, self.model_step @ self.x_c

"""A pendulum in lossy loops under attack, many runs at a time; independent of the project's simulators.

The plant is written down once more, for many states at a time. A run meets the conditions of a
certificate and no more: tests every h, updates that take up to d, inputs up to σ old, no input
before t_a, and losses that an attacker chooses up to the longest burst.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate

Reals = NDArray[np.float64]
SCENARIOS = Path(__file__).parents[2] / "scenarios"


def pendulum(x: Reals, u: Reals) -> Reals:
    """Torque on an inverted pendulum."""
    return np.stack([x[1], 9.81 * np.sin(x[0]) - 0.1 * x[1] + u[0]])


def attacked(
    resolved: Scenario,
    certificate: ScenarioCertificate,
    *,
    runs: int,
    steps: int,
    seed: int = 0,
) -> dict[str, float]:
    """Return the largest shares of the region and of the bounds that any of the runs used.

    NaN, of a plant outside its equations' domain, counts as infinite.
    """
    t_s = np.arange(steps) * certificate.conditions.sampling_s
    loops = _AttackedLoops(resolved, certificate, runs, np.random.default_rng(seed))
    worst = dict.fromkeys(("x", "u", "‖x‖", "‖e_s‖", "‖e_c‖"), 0.0)
    n, proven = len(loops.x), certificate.proven
    assert proven is not None
    entries = proven.entries(n, 1)
    limits = np.array([sum(entries[k]) if k in entries else np.inf for k in range(n + 1)])[:, None]
    limit_x, limit_u = limits[:n], limits[n:]
    bounds = [of(t_s) for of in (certificate.state, certificate.sensor_error, certificate.controller_error)]

    def share(signal: str, values: Reals, limits: Reals | float) -> None:
        used = np.max(values / limits, initial=0.0)
        worst[signal] = max(worst[signal], np.inf if np.isnan(used) else float(used))

    for number, t in enumerate(t_s.tolist()):
        share("‖e_s‖", loops.error_of(loops.x_s), bounds[1][number])
        loops.transmit(number, loops.events(number, t))
        loops.receive(number)
        u = loops.inputs()
        share("x", np.abs(loops.x), limit_x)
        share("u", np.abs(u), limit_u)
        share("‖x‖", np.linalg.norm(loops.x, axis=0), bounds[0][number])
        share("‖e_c‖", loops.error_of(loops.x_c)[loops.newest > 0], bounds[2][number])
        loops.advance(u)
    return worst


class _AttackedLoops:
    """The states of all runs, (n, runs), and their attackers.

    An attacker loses updates at random, or in bursts of the greatest length. Its delays, and the
    ages of the inputs, are random, or always the longest.
    """

    def __init__(
        self,
        resolved: Scenario,
        certificate: ScenarioCertificate,
        runs: int,
        rng: np.random.Generator,
    ) -> None:
        self.runs, self.rng, self.rule = runs, rng, resolved.decaying
        self.conditions, loop = certificate.conditions, loop_of(resolved)
        self.h = self.conditions.sampling_s
        self.weight = np.eye(loop.n) if loop.weight is None else loop.weight
        self.longest = int(self.conditions.delay_s / self.h + 1e-9)
        ages = np.linspace(0, self.conditions.hold_s - self.h, 4)
        # What e^{Ht} makes of x_s and x_c in a step, of a late update, and of K for an old input.
        self.model_step = expm(loop.H * self.h)
        self.late = np.array([expm(loop.H * self.h * steps) for steps in range(self.longest + 1)])
        self.aged_gains = np.array([loop.K @ expm(-loop.H * age) for age in ages])
        self.x = np.tile(loop.x0[:, None], runs)
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

    def events(self, number: int, t_s: float) -> NDArray[np.bool_]:
        """Test the trigger; the first test is an event."""
        if not number:
            return np.ones(self.runs, bool)
        threshold = max(self.rule.beta * np.exp(-self.rule.alpha_per_s * t_s), self.rule.floor)
        return np.asarray(self.error_of(self.x_s) > threshold)

    def transmit(self, number: int, event: NDArray[np.bool_]) -> None:
        """Reset x_s at events; the attacker loses an update, or delays it."""
        wants_loss = self.rng.random(self.runs) < self.loss_rates
        lost = event & wants_loss & (self.consecutive_losses < self.conditions.dropouts) & (number > 0)
        losses = np.where(lost, self.consecutive_losses + 1, 0)
        self.consecutive_losses = np.where(event, losses, self.consecutive_losses)
        self.sent = self.sent + event
        self.x_s = np.where(event, self.x, self.x_s)
        random_delay = self.rng.integers(0, self.longest + 1, self.runs)
        delay = np.where(self.always_longest, self.longest, random_delay)
        first_delay = np.minimum(delay, int(self.conditions.start_s / self.h + 1e-9))
        arrival = (number + (delay if number else first_delay)) % (self.longest + 1)
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
        """Integrate the plants over a step by the classical Runge-Kutta method, and the models."""
        x, h = self.x, self.h
        k1 = pendulum(x, u)
        k2 = pendulum(x + h / 2 * k1, u)
        k3 = pendulum(x + h / 2 * k2, u)
        self.x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + pendulum(x + h * k3, u))
        self.x_s, self.x_c = self.model_step @ self.x_s, self.model_step @ self.x_c

"""Nonlinear lossy loops under attack, many runs at a time; independent of the project's simulators.

The four plants are written down once more, for many states at a time. A run meets the conditions of
a certificate and no more: tests every h, updates that take up to d, inputs up to σ old, no input
before t_a, and losses that an attacker chooses up to the longest burst.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.certified_bounds import ScenarioCertificate

Reals = NDArray[np.float64]
Field = Callable[[Reals, Reals], Reals]
SCENARIOS = Path(__file__).parents[2] / "scenarios"


def pendulum(x: Reals, u: Reals) -> Reals:
    """Torque on an inverted pendulum."""
    return np.stack([x[1], 9.81 * np.sin(x[0]) - 0.1 * x[1] + u[0]])


def car(x: Reals, u: Reals) -> Reals:
    """A car without slip."""
    return np.stack([(u[0] - x[0]) / 0.1, 15 * np.tan(x[0]) / 2.6, 15 * np.sin(x[1])])


def cart_pole(x: Reals, u: Reals) -> Reals:
    """(M+m)q̈ + ml cosθ θ̈ = F − bq̇ + ml sinθ θ̇², (I+ml²)θ̈ + ml cosθ q̈ = mgl sinθ."""
    _, speed, angle, rate = x
    total, moment, inertia = 0.7, 0.06, 0.024
    pull, cosine = u[0] - 0.1 * speed + moment * np.sin(angle) * rate**2, moment * np.cos(angle)
    mass = np.array([[0 * angle + total, cosine], [cosine, 0 * angle + inertia]])
    right = np.array([pull, moment * 9.8 * np.sin(angle)])
    solved = np.linalg.solve(np.moveaxis(mass, -1, 0), right.T[..., None])[..., 0].T
    return np.stack([speed, solved[0], rate, solved[1]])


def four_tanks(x: Reals, u: Reals) -> Reals:
    """Bernoulli's law at each outlet, without cases: it is NaN for an empty tank."""
    holes, areas = np.array([[0.071, 0.057] * 2]).T, np.array([[28.0, 32.0] * 2]).T
    inflow = np.array([[2.331, 0], [0, 2.01], [0, 1.34], [0.999, 0]])
    coupling = np.array([[1.0, 0, -1, 0], [0, 1, 0, -1], [0, 0, 1, 0], [0, 0, 0, 1]])
    rest = (np.linalg.solve(coupling, inflow @ np.full((2, 1), 3.0)) / holes) ** 2 / 1962
    return (inflow @ (u + 3.0) - coupling @ (holes * np.sqrt(1962 * (rest + x)))) / areas


class Case(NamedTuple):
    """A plant whose x(0) is anywhere in an ellipsoid, with these semi-axes."""

    scenario: str
    field: Field
    semi_axes: tuple[float, ...]
    changes: tuple[str, ...] = ()

    def resolved(self) -> Scenario:
        """Return the scenario with the changes."""
        return resolve(load(SCENARIOS / f"{self.scenario}.toml", self.changes))


_CART_POLE_WEIGHT = (
    "[4.676, 2.435, 5.47, 0.9813], [0, 0.6439, 2.915, 0.3613], [0, 0, 1.695, 0.02078], [0, 0, 0, 0.1959]"
)
"""The norm that noack chooses for the linear plant, rounded: the search takes long."""
CASES = {
    "pendulum": Case("sine_pendulum", pendulum, (0.5, 0.5)),
    "kinematic car": Case("kinematic_car", car, (0.05, 0.1, 3.0)),
    "cart-pole": Case(
        "cart_pole", cart_pole, (0.02, 0.02, 0.01, 0.02),
        ("plant.rate_hz=1000", "controller.rate_hz=1000", "trigger.beta=0.005",
         "trigger.floor=0.00025", f"trigger.weight=[{_CART_POLE_WEIGHT}]"),
    ),
    "four tanks": Case(
        "four_tank", four_tanks, (0.8, 0.8, 0.2, 0.2),
        ("trigger.beta=0.02", "trigger.floor=0.001"),
    ),
}  # fmt: skip


def attacked(
    resolved: Scenario,
    case: Case,
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
    loops = _AttackedLoops(resolved, case, certificate, runs, np.random.default_rng(seed))
    worst = dict.fromkeys(("x", "u", "‖x‖", "‖e_s‖", "‖e_c‖"), 0.0)
    n, proven = len(case.semi_axes), certificate.proven
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
        case: Case,
        certificate: ScenarioCertificate,
        runs: int,
        rng: np.random.Generator,
    ) -> None:
        self.runs, self.rng, self.field, self.rule = runs, rng, case.field, resolved.decaying
        self.conditions, loop = certificate.conditions, loop_of(resolved)
        self.h = self.conditions.sampling_s
        self.weight = np.eye(loop.n) if loop.weight is None else loop.weight
        self.longest = int(self.conditions.delay_s / self.h + 1e-9)
        ages = np.linspace(0, self.conditions.hold_s - self.h, 4)
        # What e^{Ht} makes of x_s and x_c in a step, of a late update, and of K for an old input.
        self.model_step = expm(loop.H * self.h)
        self.late = np.array([expm(loop.H * self.h * steps) for steps in range(self.longest + 1)])
        self.aged_gains = np.array([loop.K @ expm(-loop.H * age) for age in ages])
        self.x = rng.normal(size=(loop.n, runs))
        self.x *= np.array(case.semi_axes)[:, None] / np.linalg.norm(self.x, axis=0)
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
        k1 = self.field(x, u)
        k2 = self.field(x + h / 2 * k1, u)
        k3 = self.field(x + h / 2 * k2, u)
        self.x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + self.field(x + h * k3, u))
        self.x_s, self.x_c = self.model_step @ self.x_s, self.model_step @ self.x_c

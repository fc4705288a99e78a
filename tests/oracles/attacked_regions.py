"""Nonlinear lossy loops under attack, many runs at a time; independent of the project's code.

The four plants are written down once more, for many states at a time. A run meets the conditions of
a certificate and no more: tests every h, updates that take up to d, inputs up to σ old, no input
before t_a, and losses that an attacker chooses up to the longest burst. ``python -m
tests.oracles.attacked_regions [RUNS]`` prints the table of docs/theory.md.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.core.linear_systems import Vector
from noack.plants.systems.jacobian_enclosure import Inclusion
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.region import RegionScope

Reals = NDArray[np.float64]
Field = Callable[[Reals, Reals], Reals]
BATCH, STEPS = 1000, 2000
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


def certificate_of(resolved: Scenario, semi_axes: tuple[float, ...]) -> ScenarioCertificate:
    """Return the certificate of all x(0) in an ellipsoid."""
    return RegionScope(resolved, start=np.diag(semi_axes)).certificate(allowed_conditions(resolved))


def inclusion_share(box: Inclusion, field: Field, widths: Vector, points: int = 4000) -> float:
    """Return the largest share of a box of matrices that f uses, in points and corners of a region."""
    rng, n = np.random.default_rng(1), len(box.A)
    z = rng.uniform(-1, 1, (points, len(widths)))
    z[::2] = np.sign(z[::2])
    z = (z * rng.uniform(0, 1, (points, 1)) ** 0.2 * widths).T
    middle, half = np.hstack([box.A, box.B]), np.hstack([box.halfwidth_A, box.halfwidth_B])
    rounding = 1e-12 * np.abs(middle) @ np.abs(z) + 1e-300
    return float((np.abs(field(z[:n], z[n:]) - middle @ z) / (half @ np.abs(z) + rounding)).max())


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
    rng, loop, conditions = np.random.default_rng(seed), loop_of(resolved), certificate.conditions
    h, n, W = conditions.sampling_s, loop.n, np.eye(loop.n) if loop.weight is None else loop.weight
    latest, ages = int(conditions.delay_s / h + 1e-9), np.linspace(0, conditions.hold_s - h, 4)
    later = np.array([expm(loop.H * h * steps) for steps in range(latest + 1)])
    step, aged = expm(loop.H * h), np.array([loop.K @ expm(-loop.H * age) for age in ages])
    x = rng.normal(size=(n, runs))
    x *= np.array(case.semi_axes)[:, None] / np.linalg.norm(x, axis=0)
    x_s, x_c = x.copy(), np.zeros_like(x)
    # Attackers: random losses, bursts in a pattern; delays and ages random, or always the longest.
    often, lazy = rng.choice([0.3, 0.6, 0.9, 1.0], runs), rng.random(runs) < 0.5
    lost, sent, newest = np.zeros(runs, int), np.zeros(runs, int), np.zeros(runs, int)
    on_way = np.zeros((latest + 1, n, runs))
    numbers = np.zeros((latest + 1, runs), int)
    worst = dict.fromkeys(("x", "u", "‖x‖", "‖e_s‖", "‖e_c‖"), 0.0)
    region = certificate.region
    assert region is not None
    limit_x, limit_u = np.array(region.x)[:, None], np.array(region.u)[:, None]
    t_s = np.arange(steps) * h
    bounds = [of(t_s) for of in (certificate.state, certificate.sensor_error, certificate.controller_error)]

    def share(what: str, values: Reals, limits: Reals | float) -> None:
        used = np.max(values / limits, initial=0.0)
        worst[what] = max(worst[what], np.inf if np.isnan(used) else float(used))

    rule = resolved.decaying
    for number, t in enumerate(t_s.tolist()):
        error = np.linalg.norm(W @ (x_s - x), axis=0)
        share("‖e_s‖", error, bounds[1][number])
        event = error > max(rule.beta * np.exp(-rule.alpha_per_s * t), rule.floor) if number else lazy | True
        share_lost = rng.random(runs) < often
        drops = event & share_lost & (lost < conditions.dropouts) & (number > 0)
        lost = np.where(event, np.where(drops, lost + 1, 0), lost)
        sent = sent + event
        x_s = np.where(event, x, x_s)
        delay = np.where(lazy, latest, rng.integers(0, latest + 1, runs))
        place = (
            number + (np.minimum(delay, int(conditions.start_s / h + 1e-9)) if not number else delay)
        ) % (latest + 1)
        on_its_way = np.flatnonzero(event & ~drops)
        ahead = np.einsum("rij,jr->ri", later[delay[on_its_way]], x[:, on_its_way])
        on_way[place[on_its_way], :, on_its_way] = ahead
        numbers[place[on_its_way], on_its_way] = sent[on_its_way]
        here = number % (latest + 1)
        arrived = numbers[here] > newest
        x_c = np.where(arrived, on_way[here], x_c)
        newest = np.where(arrived, numbers[here], newest)
        numbers[here] = 0
        known = newest > 0
        age = np.where(lazy, len(ages) - 1, rng.integers(0, len(ages), runs))
        u = np.where(known, np.einsum("rmn,nr->mr", aged[age], x_c), 0.0)
        share("x", np.abs(x), limit_x)
        share("u", np.abs(u), limit_u)
        share("‖x‖", np.linalg.norm(x, axis=0), bounds[0][number])
        share("‖e_c‖", np.linalg.norm(W @ (x_c - x), axis=0)[known], bounds[2][number])
        k1 = case.field(x, u)
        k2 = case.field(x + h / 2 * k1, u)
        k3 = case.field(x + h / 2 * k2, u)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + case.field(x + h * k3, u))
        x_s, x_c = step @ x_s, step @ x_c
    return worst


def main(runs: int) -> None:
    """Print the table: each plant, its region, M, the bound, and what the attacks reached."""
    print("| plant | x(0) in the ellipsoid of | M | region | ‖x‖ ≤ | runs | reached |")
    print("|---|---|---|---|---|---|---|")
    for name, case in CASES.items():
        resolved = case.resolved()
        certificate = certificate_of(resolved, case.semi_axes)
        region, constants, loop = certificate.region, certificate.constants, loop_of(resolved)
        assert region is not None
        assert constants is not None
        limits = zip((*loop.state_names, *loop.input_names), region.x + region.u, strict=True)
        worst = dict.fromkeys(("x", "‖x‖"), 0.0)
        for seed in range(0, runs, BATCH):
            found = attacked(
                resolved, case, certificate, runs=min(BATCH, runs - seed), steps=STEPS, seed=seed
            )
            worst = {what: max(most, found[what]) for what, most in worst.items()}
            assert max(found.values()) <= 1, found
        print(
            f"| {name} | {', '.join(map(str, case.semi_axes))} "
            f"| {certificate.conditions.dropouts + 1} "
            f"| {', '.join(f'{of} {limit:.3g}' for of, limit in limits)} "
            f"| {constants.state:.3g} e^(−{constants.rate_per_s:g} t) | {runs:,} "
            f"| {worst['x']:.2f} of the region, {worst['‖x‖']:.2f} of the bound |",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else BATCH)

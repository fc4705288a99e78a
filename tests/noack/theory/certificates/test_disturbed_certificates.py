"""Disturbances and noise of scenarios: boxes, normal values, and the shipped scenarios' bounds."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.bounds.box import BoxGains
from noack.theory.bounds.certificate_terms import (
    CertificatePart,
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, Forcing, NormalForcing, PlantGains
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.persistent_bounds import solve_two_parts
from noack.theory.certificates.scenario_certificates import certify
from noack.theory.certificates.solution import completed_alone, solve
from tests.noack.theory.certificates.disturbed_loops import Sum, random_disturbed_loop, signals
from tests.oracles.lossy_loops import RUNS, STEPS, Plants, System, networks, random_system, simulate

ROOT = Path(__file__).parents[4]


def box_certificate(system: System, columns: np.ndarray, half: float, floor: float) -> Sum:
    def plant(alpha: float, start: np.ndarray, forcing: Forcing | None) -> PlantGains:
        models = ErrorGains(system.H, system.K, system.weight, alpha)
        halves = np.full_like(system.A, half), np.full_like(system.B, half)
        return BoxGains(models, system.A, system.B, start, alpha, *halves, forcing=forcing)

    k, m = columns.shape[1], system.B.shape[1]
    forcing = Forcing(columns, np.full(k, np.inf), np.zeros(m))
    first = plant(system.alpha, system.x0[:, None], None)
    rest = plant(0.0, np.zeros((len(system.A), 1)), forcing)
    return Sum(system, *completed_alone(solve_two_parts(
        CertificatePart(first.error, first, TriggerBound(system.beta, None)),
        CertificatePart(rest.error, rest, TriggerBound(floor, None, unit=1.0)),
        system.conditions,
    )))  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_no_plant_of_a_disturbed_box_exceeds_its_bounds(seed: int) -> None:
    """Half of the runs switch between corners of the box at every step."""
    rng = np.random.default_rng(seed)
    while True:
        loop = random_disturbed_loop(rng, mismatch=0.0, noise=0.0, n=2, lasting=STEPS, floor=0.3)
        half = 0.02
        try:
            found = box_certificate(loop.system, loop.columns, half, loop.floor)
        except (NoCertificateError, NotDecayingError):
            continue
        break
    system = loop.system
    pool = [
        tuple(M + half * rng.choice([-1.0, 1.0], M.shape) for M in (system.A, system.B)) for _ in range(6)
    ]
    which = rng.integers(0, 6, (RUNS, STEPS))
    which[::2] = which[::2, :1]
    plants = Plants(pool, which)  # type: ignore[arg-type]
    pushes, _ = signals(loop, rng)
    drawn = networks(seed, system)
    trace = simulate(system, *drawn, floor=loop.floor, pushes=pushes, plants=plants)
    shares = found.shares(trace)
    assert max(shares.values()) <= 1 + 1e-9, shares
    # Without the disturbance the bounds would be exceeded, or come closer.
    narrow = box_certificate(system, 1e-6 * loop.columns, half, loop.floor).shares(trace)
    assert narrow["x"] > shares["x"]


@pytest.mark.parametrize("alpha", [0.1, 1.0])
@pytest.mark.parametrize("share_of_A", [0.0, 0.3, 1.0])
def test_a_scalar_box_is_as_large_as_it_can_be(alpha: float, share_of_A: float) -> None:
    """ẋ = (a + bk)x + bp with rate λ: certified while the worst corner, λ − |ã| − |b̃k|, exceeds α.

    There, x is bounded by x₀ and |b|π over the worst rate's margin, exactly.
    """
    rate, k, beta, x0 = 2.0, -3.0, 0.1, 0.7
    one, whole = np.eye(1), rate - alpha
    models = ErrorGains(-rate * one, k * one, one, alpha)

    def certified(size: float, half_A: float, half_B: float) -> Constants:
        halves = size * half_A * one, size * half_B * one
        plant = BoxGains(models, one, one, x0 * one, alpha, *halves)
        return solve(models, plant, NetworkConditions(2), TriggerBound(beta, beta))

    half_A, half_B = whole * share_of_A, whole * (1 - share_of_A) / -k
    with pytest.raises(NotDecayingError, match="box is too large"):
        certified(1.005, half_A, half_B)
    for size in (0.1, 0.5, 0.95):
        found = certified(size, half_A, half_B)
        state, p, margin = found.state, found.input_error, whole * (1 - size)
        forced = (1.0 + size * half_B) * p
        start = x0 * whole / margin  # bound for a state that does not decay
        # The enclosures' 0.5 %, and the separate bounds of start and input error.
        assert state == pytest.approx(start + forced / margin, rel=0.15)
        assert state >= (start + forced / margin) * (1 - 1e-9)
        # w of the state and of the corresponding input.
        w = size * (half_A * state + half_B * (-k * state + p))
        assert found.mismatch == pytest.approx(w, rel=1e-3)


def test_the_response_to_normal_disturbances_stays_within_its_radius() -> None:
    """Of many normal runs, at most about the assumed share exceeds the bound; it is not far off."""
    rng, period_s = np.random.default_rng(0), 0.02
    for _ in range(5):
        system = random_system(rng, n=2, mismatch=0.0)
        models = ErrorGains(system.H, system.K, system.weight, 0.0)
        D, radius = rng.normal(size=(2, 2)), 3.0
        normal = NormalForcing(D, period_s, limit=radius, radius=radius)
        forcing = Forcing(np.zeros((2, 0)), np.zeros(0), np.zeros(system.B.shape[1]), normal)
        start = np.zeros((2, 1))
        plant = PlantGains(models, system.A, system.B, start, 0.0, forcing=forcing)
        M, C = plant.closed_loop, rng.normal(size=(1, 2))
        bound = plant.disturbed(C)
        # Euler's method with small steps, independent of matrix exponentials.
        x, fine, largest = np.zeros((400, 2)), 50, np.zeros(400)
        for _ in range(int(10 / -np.linalg.eigvals(M).real.max() / period_s)):
            push = rng.normal(size=(400, 2)) @ D.T
            for _ in range(fine):
                x = x + period_s / fine * (x @ M.T + push)
            largest = np.maximum(largest, np.abs(x @ C.T)[:, 0])
        stationary = np.abs(x @ C.T)[:, 0]
        assert (stationary > bound).mean() < 0.03  # chi squared with 2 degrees beyond 3²: 0.011
        assert largest.max() > 0.3 * bound


FIGURES: dict[str, dict[str, Any]] = {
    "lane_crosswind": {"state": 22.60, "delta": 2.416},
    "pendulum_observed": {"state": 7.768, "delta": 2.1295, "estimation_error": 0.09161},
}


@pytest.mark.parametrize("name", FIGURES)
def test_the_shipped_disturbed_scenarios_have_their_documented_bounds(name: str) -> None:
    rest = scheduled(name).persistent_constants
    assert rest is not None
    text = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
    for key, value in FIGURES[name].items():
        assert getattr(rest, key) == pytest.approx(value, rel=1e-3)
        assert f"{value:.3g}" in text


def scheduled(name: str, *settings: str) -> ScenarioCertificate:
    resolved = resolve(load(ROOT / "scenarios" / f"{name}.toml", settings))
    return certify(resolved, allowed_conditions(resolved))

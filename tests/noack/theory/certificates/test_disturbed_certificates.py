"""Disturbances of a box of plants, and the bounds of the shipped disturbed scenarios."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.bounds.box import BoxGains
from noack.theory.bounds.certificate_terms import CertificatePart, NoCertificateError, TriggerBound
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, Forcing, PlantGains
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.persistent_bounds import solve_two_parts
from noack.theory.certificates.scenario_certificates import certify
from tests.noack.theory.certificates.certified_loops import conditions_of
from tests.noack.theory.certificates.disturbed_loops import Sum, random_disturbed_loop, signals
from tests.oracles.lossy_loops import RUNS, STEPS, Plants, System, networks, simulate

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
    return Sum(system, *solve_two_parts(
        CertificatePart(first.error, first, TriggerBound(system.beta, None)),
        CertificatePart(rest.error, rest, TriggerBound(floor, None, unit=1.0)),
        conditions_of(system),
    ))  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_no_plant_of_a_disturbed_box_exceeds_its_bounds(seed: int) -> None:
    """Half of the runs switch between corners of the box at every step."""
    rng = np.random.default_rng(seed)
    while True:
        loop = random_disturbed_loop(rng, mismatch=0.0, noise=0.0, n=2, lasting=STEPS, floor=0.3)
        half = 0.02
        try:
            certificate = box_certificate(loop.system, loop.columns, half, loop.floor)
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
    shares = certificate.shares(trace)
    assert max(shares.values()) <= 1 + 1e-9, shares
    # Without the disturbance the bounds would be exceeded, or come closer.
    narrow = box_certificate(system, 1e-6 * loop.columns, half, loop.floor).shares(trace)
    assert narrow["x"] > shares["x"]


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

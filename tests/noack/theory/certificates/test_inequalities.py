"""Linear inequalities, the first passage of a threshold, and the table of the documents."""

import math
from fractions import Fraction

import numpy as np
import pytest

from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.gains import PlantGains
from noack.theory.bounds.trigger_bounds import first_passage_s
from noack.theory.certificates.inequalities import solve_inequalities
from tests.oracles.lossy_loops import System


def exact_solution(F: np.ndarray, g: np.ndarray) -> list[Fraction]:
    size = len(g)
    rows = [
        [Fraction(int(i == j)) - Fraction(float(F[i, j])) for j in range(size)] + [Fraction(float(g[i]))]
        for i in range(size)
    ]
    for k in range(size):
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for i in range(size):
            if i != k:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("radius", [0.3, 0.99, 1 - 1e-9])
def test_the_bound_is_above_the_exact_solution_and_close_to_it(size: int, radius: float) -> None:
    rng = np.random.default_rng([size, int(1e9 * radius)])
    for _ in range(50):
        F = rng.uniform(size=(size, size)) * (rng.uniform(size=(size, size)) < 0.8)
        F *= radius / max(np.abs(np.linalg.eigvals(F)).max(), 0.1)
        g = rng.uniform(size=size)
        unused = rng.integers(size + 1)
        F[unused : unused + 1], g[unused : unused + 1] = 0.0, 0.0
        scale = 10.0 ** (rng.integers(-150, 150) + rng.integers(-2, 3, size))
        F, g = F * (scale[:, None] / scale), g * scale
        found = solve_inequalities(F, g)
        assert np.isfinite(found.bound).all()
        assert found.loop_gain < 1
        for bound, exact in zip(found.bound, exact_solution(F, g), strict=True):
            assert Fraction(float(bound)) >= exact
            assert float(bound) <= float(exact) * (1 + 1e-10 / (1 - radius))


def test_a_spectral_radius_of_1_or_more_has_no_bound() -> None:
    rng = np.random.default_rng(0)
    for size in (1, 2, 3, 5):
        F = rng.uniform(size=(size, size))
        F /= np.abs(np.linalg.eigvals(F)).max()
        for radius in (1 + 1e-12, 1.5, 40.0):
            found = solve_inequalities(radius * F, np.ones(size))
            assert np.isinf(found.bound).all()
            assert found.loop_gain >= 1 - 1e-9
    assert np.isinf(solve_inequalities(np.full((2, 2), np.nan), np.ones(2)).bound).all()


def passage_s(plant: PlantGains, *values: float) -> float:
    """The first passage of one loop from 0."""
    return float(first_passage_s(plant, *np.array([*values, 0.0])[:, None])[0])


def test_without_mismatch_or_push_the_threshold_is_never_reached() -> None:
    system = System(
        A=np.array([[-2.0]]), B=np.array([[1.0]]), K=np.array([[0.0]]), H=np.array([[-2.0]]),
        weight=np.eye(1), x0=np.ones(1), alpha=1.0, beta=0.1, known_start=True, mansd=0,
        step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=0, lag_steps=0,
    )  # fmt: skip
    plant = system.gains()
    assert passage_s(plant, 0.1, 0.0, 0.0, 0.0) >= 1e6
    found = system.certify(NetworkConditions(0))
    assert found.inter_event_s is not None
    assert found.inter_event_s >= 1e6
    # ρ = π'(1 − e^{−t}): never above π', and half of it at ln 2.
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) == pytest.approx(math.log(2), rel=0.01)
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) <= math.log(2)
    assert passage_s(plant, 1.01, 0.0, 1.0, 0.0) > 4

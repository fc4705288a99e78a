"""First roots of polynomials, without compilation: the functions that the batch engine compiles."""

import math

import numpy as np
import pytest

from cosim.simulation.batch import level_crossing, norm_crossing
from cosim.simulation.batch.level_crossing import estimate, first_root
from cosim.simulation.batch.norm_crossing import NONE, UNRESOLVED, Search
from noack.core.linear_systems import Vector


def coefficients(zeros: Vector, leading: float) -> Vector:
    """Coefficients of ``leading`` Π (s − zero), lowest power first."""
    return np.asarray(leading * np.poly(zeros)[::-1].real)


def root(
    g: Vector, level: float = 0.0, rate: float = 0.0, *, grain: float = 0.0, end_s: float = 1.0
) -> float:
    return first_root(g, len(g) - 1, Search(level, rate, end_s, False), grain)


@pytest.mark.parametrize("seed", range(25))
def test_the_first_of_known_roots_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inside = rng.uniform(0.05, 1, rng.integers(0, 4))
    outside = np.concatenate([rng.uniform(1.1, 3, 2), -rng.uniform(0.1, 3, 2)])
    pair = rng.uniform(0.1, 0.9) + 1j * 10.0 ** rng.uniform(-5, 0)
    g = coefficients(np.concatenate([inside, outside, [pair, pair.conjugate()]]), 1.0)
    g = -g * np.sign(g[0])
    found = root(g, grain=1e-15 * abs(g[0]))
    if len(inside):
        assert found == pytest.approx(inside.min(), rel=1e-8)
    else:
        assert found == NONE


def test_a_root_against_a_decaying_level_is_found() -> None:
    """s² = e^{−2s} at the root of s = e^{−s}, the omega constant."""
    g = np.array([0.0, 0.0, 1.0])
    assert root(g, 1.0, 2.0) == pytest.approx(0.5671432904097838, rel=1e-15)
    assert root(g, 1.0, 2.0, end_s=0.567) == NONE


def test_a_start_on_the_level_is_an_event_only_if_the_value_rises() -> None:
    assert root(np.array([1.0, 1e-3, 0.0]), 1.0) == 0.0
    assert root(np.array([1.0, -1.0, 2.0]), 1.0) == pytest.approx(0.5)
    assert root(np.array([1.0, -1.0, 0.5]), 1.0) == NONE
    assert root(np.array([1.0 + 1e-9, -1.0, 0.0]), 1.0, grain=1e-15) == 0.0
    assert root(np.zeros(3)) == NONE
    assert root(np.array([-1.0, 1.0, 0.0]), end_s=0.0) == NONE


def test_too_many_steps_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """(s − ½)² s² almost touches 0 from below."""
    g = -coefficients(np.array([0.5, 0.5, -1.0, -1.0]), 1.0)
    g[0] -= 1e-12
    assert root(g) == NONE
    monkeypatch.setattr(level_crossing, "MOST_STEPS", 5)
    assert root(g) == UNRESOLVED


def test_a_root_is_found_by_bisection_without_newton_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(norm_crossing, "NEWTON_STEPS", 0)
    g = np.array([-0.1, 0.0, 0.0, 1.0])
    found = root(g)
    assert found == pytest.approx(0.1 ** (1 / 3), rel=1e-15)


def test_an_estimate_is_the_root_of_a_parabola() -> None:
    assert estimate(np.array([-1.0, 0.0, 4.0]), 0.0, 0.0) == 0.5
    assert estimate(np.array([0.0, -1.0, 4.0]), 0.0, 0.0) == 0.25
    assert estimate(np.array([-3.0, 4.0, -1.0]), 0.0, 0.0) == 1.0
    assert estimate(np.array([-1.0, 0.0, -1.0]), 0.0, 0.0) == math.inf
    assert estimate(np.array([-1.0, 1.0, -1.0]), 0.0, 0.0) == math.inf

"""The solution of linear inequalities, against exact arithmetic."""

from fractions import Fraction

import numpy as np
import pytest

from noack.theory.certificates.inequalities import solve_inequalities


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
        solution = solve_inequalities(F, g)
        assert np.isfinite(solution.bound).all()
        assert solution.loop_gain < 1
        for bound, exact in zip(solution.bound, exact_solution(F, g), strict=True):
            assert Fraction(float(bound)) >= exact
            assert float(bound) <= float(exact) * (1 + 1e-10 / (1 - radius))


def test_a_spectral_radius_of_1_or_more_has_no_bound() -> None:
    rng = np.random.default_rng(0)
    for size in (1, 2, 3, 5):
        F = rng.uniform(size=(size, size))
        F /= np.abs(np.linalg.eigvals(F)).max()
        for radius in (1 + 1e-12, 1.5, 40.0):
            solution = solve_inequalities(radius * F, np.ones(size))
            assert np.isinf(solution.bound).all()
            assert solution.loop_gain >= 1 - 1e-9
    assert np.isinf(solve_inequalities(np.full((2, 2), np.nan), np.ones(2)).bound).all()

"""Many polynomial curves at once, against single curves and against dense sampling."""

import numpy as np
import pytest

from cosim.analysis.adversary.polynomial_curves import Stack, curve_stack, peak_squares, powers
from cosim.simulation.continuous.bernstein import curve_basis

DEGREE = 18


def curves(rng: np.random.Generator, count: int, size: float) -> Stack:
    """Smooth curves that cross the unit sphere never, once or several times."""
    falling = 1.0 / np.cumprod([1.0, *(np.arange(1.0, DEGREE + 1) / 6)])
    return np.asarray(size * falling[:, None] * rng.normal(size=(count, DEGREE + 1, 2)))


@pytest.mark.parametrize("size", [0.2, 0.5, 1.0])
def test_first_exits_are_those_of_single_curves(size: float) -> None:
    taylor = curves(np.random.default_rng(0), 300, size)
    found = curve_stack(DEGREE).first_exits(taylor)
    expected = [curve_basis(DEGREE).first_exit(one) for one in taylor]
    assert np.isnan(found).tolist() == [u is None for u in expected]
    crossed = ~np.isnan(found)
    assert crossed.any()
    reference = [u for u in expected if u is not None]
    np.testing.assert_allclose(found[crossed], reference, rtol=0, atol=1e-9)


def test_a_peak_is_the_maximum_of_its_neighbourhood() -> None:
    """Against 10,001 points; their squared spacing times the curvature is below 1e-8."""
    taylor = curves(np.random.default_rng(1), 100, 1.0)
    grid = np.linspace(0.0, 1.0, 10_001)
    squares = ((powers(grid, DEGREE) @ taylor) ** 2).sum(axis=2)
    at, reach = grid[squares[:, ::100].argmax(axis=1) * 100], 0.01
    near = np.abs(grid - at[:, None]) <= reach
    expected = np.where(near, squares, 0.0).max(axis=1)
    found = peak_squares(taylor, at, reach)
    assert (found >= expected * (1 - 1e-12)).all()
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_bernstein_coefficients_enclose_and_halve() -> None:
    stack = curve_stack(DEGREE)
    for one in curves(np.random.default_rng(2), 20, 1.0):
        coefficients = stack.squares(one[None])[0]
        grid = np.linspace(0.0, 1.0, 101)
        squares = ((powers(grid, DEGREE) @ one) ** 2).sum(axis=1)
        assert coefficients.max() >= squares.max() * (1 - 1e-12)
        assert coefficients[[0, -1]] == pytest.approx(squares[[0, -1]])
        left, right = stack.halves(coefficients)
        assert left[-1] == right[0] == pytest.approx(squares[50])
        assert max(left.max(), right.max()) <= coefficients.max() * (1 + 1e-12)

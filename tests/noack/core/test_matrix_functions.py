"""Functions of matrices against scipy's, and against closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from noack.core.matrix_functions import exponential, solve_lyapunov

SIZES = (1, 2, 5, 14)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("scale", [0.0, 1e-9, 0.3, 0.95, 4.0, 60.0])
def test_exponentials_are_those_of_scipy(n: int, scale: float) -> None:
    matrix = scale * np.random.default_rng(n).uniform(-1, 1, (n, n)) / np.sqrt(n)
    expected = expm(matrix)
    error = np.linalg.norm(exponential(matrix) - expected)
    assert error <= 1e-12 * max(scale, 1) * np.linalg.norm(expected)


def test_exponentials_of_nilpotent_and_stiff_matrices_are_exact() -> None:
    shift = np.array([[0.0, 1e6], [0.0, 0.0]])
    assert exponential(shift) == pytest.approx(np.eye(2) + shift, rel=1e-12)
    stiff = exponential(np.diag([-500.0, -1e-3]))
    assert np.diag(stiff) == pytest.approx(np.exp([-500.0, -1e-3]), rel=1e-12)


@pytest.mark.parametrize("n", SIZES)
def test_lyapunov_equations_are_solved(n: int) -> None:
    rng = np.random.default_rng(n)
    M = rng.uniform(-1, 1, (n, n)) - 3 * np.eye(n)
    Q = rng.uniform(-1, 1, (n, n))
    found = solve_lyapunov(M, Q)
    assert M @ found + found @ M.T == pytest.approx(Q, abs=1e-12)
    assert found == pytest.approx(solve_continuous_lyapunov(M, Q), abs=1e-12)


def test_a_lyapunov_equation_without_a_solution_is_an_error() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        solve_lyapunov(np.diag([1.0, -1.0]), np.eye(2))

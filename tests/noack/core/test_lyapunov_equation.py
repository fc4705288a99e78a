"""The Lyapunov equation against scipy's solution."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from noack.core.linear_systems import solve_lyapunov

SIZES = (1, 2, 5, 14)


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

"""The gains among which a design chooses: regulators."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from cosim.studies.design.design_space import weighed_gain
from netem.core.errors import CallerError
from noack.core.linear_systems import spectral_abscissa
from noack.plants.linear import lane_following


def test_the_gain_comes_from_a_solution_of_the_riccati_equation() -> None:
    A, B, *_ = lane_following()
    Q, R = np.diag([1.0, 2.0, 3.0, 4.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    K = weighed_gain(A, B, Q, R)
    closed = A + B @ K
    assert spectral_abscissa(closed) < 0
    # P is the cost of the closed loop by another equation; K must follow from it.
    cost = Q + K.T @ R @ K
    P = solve_continuous_lyapunov(closed.T, -cost)
    np.testing.assert_allclose(R @ K, -B.T @ P, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("A", "Q", "R", "word"),
    [
        ([[1, 0], [0, -1]], [[1, 0], [0, 1]], 1, "stabilising"),  # B does not affect state 1
        ([[0, 1], [0, 0]], [[-1, 0], [0, -1]], 1, "semidefinite"),
        ([[0, 1], [0, 0]], [[1, 1], [0, 1]], 1, "symmetric"),
        ([[0, 1], [0, 0]], [[1, 0], [0, 1]], 0, "definite"),
    ],
)
def test_a_system_without_a_regulator_is_refused(
    A: list[list[float]], Q: list[list[float]], R: float, word: str
) -> None:
    with pytest.raises(CallerError, match=word):
        weighed_gain(np.array(A), np.array([[0.0], [1.0]]), np.array(Q), np.array([[R]]))

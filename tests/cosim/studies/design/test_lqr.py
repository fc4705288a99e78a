"""The regulator's gain, against its defining equation and a closed form."""

import numpy as np
import pytest

from cosim.studies.design.loop_families import lqr_gain
from noack.config.named_models import lane_following
from noack.core.errors import CallerError
from noack.core.linear_systems import spectral_abscissa


def test_the_gain_comes_from_a_solution_of_the_riccati_equation() -> None:
    A, B, *_ = lane_following({})
    Q, R = np.diag([1.0, 2.0, 3.0, 4.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    K = lqr_gain(A, B, Q, R)
    closed = A + B @ K
    assert spectral_abscissa(closed) < 0
    # P is the cost of the closed loop by another equation; K must follow from it.
    cost = Q + K.T @ R @ K
    n = len(A)
    lyapunov = np.kron(np.eye(n), closed.T) + np.kron(closed.T, np.eye(n))
    P = np.linalg.solve(lyapunov, -cost.ravel()).reshape(n, n)
    np.testing.assert_allclose(R @ K, -B.T @ P, rtol=1e-8, atol=1e-8)
    residual = A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q
    np.testing.assert_allclose(residual, 0.0, atol=1e-7)


def test_the_double_integrator_has_its_textbook_gain() -> None:
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    np.testing.assert_allclose(
        lqr_gain(A, B, np.eye(2), np.eye(1)), [[-1.0, -np.sqrt(3.0)]], rtol=1e-9
    )


@pytest.mark.parametrize(
    ("A", "Q", "R", "word"),
    [
        ([[1.0, 0.0], [0.0, -1.0]], np.eye(2), 1.0, "stabilising"),  # B does not affect state 1
        ([[0.0, 1.0], [0.0, 0.0]], -np.eye(2), 1.0, "semidefinite"),
        ([[0.0, 1.0], [0.0, 0.0]], np.array([[1.0, 1.0], [0.0, 1.0]]), 1.0, "symmetric"),
        ([[0.0, 1.0], [0.0, 0.0]], np.eye(2), 0.0, "definite"),
    ],
)
def test_a_system_without_a_regulator_is_refused(
    A: list[list[float]], Q: np.ndarray, R: float, word: str
) -> None:
    with pytest.raises(CallerError, match=word):
        lqr_gain(np.array(A), np.array([[0.0], [1.0]]), Q, np.array([[R]]))

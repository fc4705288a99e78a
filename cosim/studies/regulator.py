"""The linear-quadratic regulator."""

import numpy as np

from noack.core.linear_systems import Matrix, spectral_abscissa


def lqr_gain(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return K of u = K x, (m, n): K = −R⁻¹BᵀP, AᵀP + PA − PBR⁻¹BᵀP + Q = 0.

    Raise LinAlgError if no P makes the loop stable; ValueError if Q or R is not a valid weight.
    """
    from scipy.linalg import solve_continuous_are  # importing scipy takes 0.2 s

    P = solve_continuous_are(A, B, Q, R)
    K = np.asarray(-np.linalg.solve(R, B.T @ P), dtype=np.float64)
    if not spectral_abscissa(A + B @ K) < 0:
        raise np.linalg.LinAlgError("it does not make the loop stable")
    return K

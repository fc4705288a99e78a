"""The linear-quadratic regulator."""

import numpy as np

from noack.core.linear_systems import Matrix, spectral_abscissa


def lqr_gain(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return K of u = K x, (m, n): K = −R⁻¹BᵀP, AᵀP + PA − PBR⁻¹BᵀP + Q = 0.

    Raise LinAlgError if no P makes the loop stable; ValueError if Q or R is not a valid weight.
    """
    from scipy.linalg import solve_continuous_are  # importing scipy takes 0.2 s

    # In units of the inputs in which R has ones on its diagonal: the solver needs inputs of a usual size.
    sizes = np.diagonal(R)
    units = np.where(sizes > 0, np.abs(sizes), 1.0) ** -0.5
    B_scaled, R_scaled = B * units, R * np.outer(units, units)
    P = solve_continuous_are(A, B_scaled, Q, R_scaled)
    K = units[:, None] * np.asarray(-np.linalg.solve(R_scaled, B_scaled.T @ P), dtype=np.float64)
    if not spectral_abscissa(A + B @ K) < 0:
        raise np.linalg.LinAlgError("it does not make the loop stable")
    return K

"""The linear-quadratic regulator of the nominal model: K that minimises ∫ xᵀQx + uᵀRu dt."""

import numpy as np

from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix


def lqr_gain(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return K of u = K x, (m, n): K = −R⁻¹BᵀP, AᵀP + PA − PBR⁻¹BᵀP + Q = 0.

    Raises:
        CallerError: Q or R is not a valid weight, or no P makes the loop stable.
    """
    from scipy.linalg import solve_continuous_are

    for name, matrix, least in (("--Q", Q, "semidefinite"), ("--R", R, "definite")):
        if not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0):
            raise CallerError(f"{name}: must be symmetric")
        smallest = np.linalg.eigvalsh(matrix)[0]
        if smallest < -1e-12 * np.abs(matrix).max() or (least == "definite" and smallest <= 0):
            raise CallerError(f"{name}: must be positive {least}")
    try:
        P = solve_continuous_are(A, B, Q, R)
    except np.linalg.LinAlgError:
        raise CallerError(
            "--gain lqr: the Riccati equation of this model has no stabilising solution; "
            "every unstable mode must be within the inputs' reach and weighed by Q"
        ) from None
    return np.asarray(-np.linalg.solve(R, B.T @ P), dtype=np.float64)

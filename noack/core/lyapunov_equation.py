"""The Lyapunov equation of small systems in numpy: importing scipy.linalg takes 0.2 s.

It is for bounds, which are enlarged by more than its rounding.
"""

import numpy as np

from noack.core.linear_systems import Matrix

_MOST_STATES = 12
"""The linear equations of a Lyapunov equation grow with the fourth power of the states."""


def solve_lyapunov(M: Matrix, Q: Matrix) -> Matrix:
    """Return X with M X + X Mᵀ = Q, (n, n).

    Raises:
        numpy.linalg.LinAlgError: there is no unique solution.
    """
    n = len(M)
    if n > _MOST_STATES:
        from scipy.linalg import solve_continuous_lyapunov

        return np.asarray(solve_continuous_lyapunov(M, Q))
    one = np.eye(n)
    equations = np.kron(M, one) + np.kron(one, M)
    return np.asarray(np.linalg.solve(equations, Q.ravel()).reshape(n, n))

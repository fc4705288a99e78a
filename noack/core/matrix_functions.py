"""Functions of small matrices in numpy: the import of scipy.linalg takes a fifth of a second.

They are for bounds, which are enlarged by more than their rounding. Runs use scipy's
(:mod:`noack.core.linear_systems`).
"""

import math

import numpy as np

from noack.core.linear_systems import Matrix

_PADE = (17297280.0, 8648640.0, 1995840.0, 277200.0, 25200.0, 1512.0, 56.0, 1.0)
_NORM = 0.95
"""Up to this norm the approximant of degree 7 is exact to rounding (Higham 2005, table 2.3)."""
_MOST_STATES = 12
"""The linear equations of a Lyapunov equation grow with the fourth power of the states."""


def exponential(matrix: Matrix) -> Matrix:
    """Return e^M, (n, n), by Padé's approximant, scaling and squaring."""
    norm = float(np.abs(matrix).sum(axis=0).max(initial=0.0))
    halvings = max(math.frexp(norm / _NORM)[1], 0)
    M, one = np.ldexp(matrix, -halvings), np.eye(len(matrix))
    M2 = M @ M
    M4 = M2 @ M2
    M6, c = M4 @ M2, _PADE
    odd = M @ (c[7] * M6 + c[5] * M4 + c[3] * M2 + c[1] * one)
    even = c[6] * M6 + c[4] * M4 + c[2] * M2 + c[0] * one
    found = np.linalg.solve(even - odd, even + odd)
    for _ in range(halvings):
        found = found @ found
    return np.asarray(found)


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

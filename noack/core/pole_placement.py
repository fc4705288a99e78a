"""Gains that give a linear system the eigenvalues that are asked for."""

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix

_TOLERANCE = 1e-6
"""Largest difference of a coefficient of the closed loop's polynomial, relative to the largest one."""
_MOST_ROUNDS, _CHANGE = 100, 1e-3
"""Rounds of SciPy's search for a gain, and the relative change at its end."""


def place_poles(A: Matrix, B: Matrix, poles: NDArray[np.complex128]) -> Matrix:
    """Return the gain K, (m, n), with these eigenvalues of A + BK.

    With several inputs it is that of Tits and Yang, which depends little on errors of A and B.

    Args:
        A: (n, n).
        B: (n, m); the pair is controllable.
        poles: (n,); one may be repeated as often as B has independent columns, and if these are one, as
            often as wanted.

    Raises:
        ValueError: there is no such gain, or it is too inexact.
    """
    from scipy.signal import place_poles as placed  # importing scipy takes 0.2 s

    if np.iscomplexobj(np.poly(poles)):
        raise ValueError("complex ones must be in conjugate pairs, e.g. -2+1j,-2-1j")
    inputs, most = int(np.linalg.matrix_rank(B)), max(poles.tolist().count(pole) for pole in poles)
    if inputs == 1 and most > 1:
        return _ackermann(A, B, poles)
    if most > inputs:
        raise ValueError(f"none may occur more than {inputs} times (independent inputs; observer: outputs)")
    return np.asarray(-placed(A, B, poles, maxiter=_MOST_ROUNDS, rtol=_CHANGE).gain_matrix, np.float64)


def _ackermann(A: Matrix, B: Matrix, poles: NDArray[np.complex128]) -> Matrix:
    """Return the gain for B = b vᵀ of rank 1 with |v| = 1: K = −v eₙᵀ [b, Ab, …]⁻¹ φ(A).

    φ is the polynomial with these roots (Ackermann, 1972). So that rounding matters little, the roots are
    taken from their mean, which is subtracted from A, too, in units of the size of this difference.
    """
    identity, mean = np.eye(len(A)), float(poles.real.mean())
    size = float(np.linalg.norm(A - mean * identity, 2)) or 1.0
    shifted, wanted = (A - mean * identity) / size, np.poly((poles - mean) / size)
    left, gains, right = np.linalg.svd(B / size)
    columns = [left[:, 0] * gains[0]]
    for _ in identity[1:]:
        columns.append(shifted @ columns[-1])
    of_shifted = np.zeros_like(A)
    for coefficient in wanted:  # Horner's rule
        of_shifted = of_shifted @ shifted + coefficient * identity
    k = -np.linalg.solve(np.array(columns), identity[-1]) @ of_shifted
    difference = np.abs(np.poly(shifted + np.outer(columns[0], k)) - wanted).max()
    if not difference <= _TOLERANCE * np.abs(wanted).max():
        raise ValueError("too far from those of the system to be placed exactly; give nearer ones")
    return np.outer(right[0], k)

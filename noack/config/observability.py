"""What of a state can be seen in an output, and how fast an observer may follow it."""

import numpy as np

from noack.core.linear_systems import Matrix

_UNSEEN = 1e-9
_MISPLACED = 1e-6


def unseen_mode(A: Matrix, C: Matrix, *, stable_too: bool = False) -> complex | None:
    """An eigenvalue of a discrete-time A whose mode does not show in y = C x; None if none.

    The test of Popov, Belevitch and Hautus: the columns of [λI − A; C] are independent. Unless
    asked for, modes that decay by themselves may remain unseen (detectability).

    Args:
        A: shape (n, n).
        C: shape (p, n).
        stable_too: whether these are looked at, too (observability).
    """
    n = len(A)
    scale = max(float(np.linalg.norm(A, 2)), 1.0)
    seen = C / max(float(np.linalg.norm(C, 2)), np.finfo(float).tiny)
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) < 1 - _UNSEEN and not stable_too:
            continue
        tested = np.vstack([(eigenvalue * np.eye(n) - A) / scale, seen])
        if np.linalg.svd(tested, compute_uv=False)[-1] < _UNSEEN:
            return complex(eigenvalue)
    return None


def observer_gain(A: Matrix, C: Matrix, poles: tuple[complex, ...]) -> Matrix:
    """L, shape (n, p), so that (I − L C) A has these eigenvalues.

    It is the gain of a state feedback of the dual pair (Aᵀ, (CA)ᵀ): Tits and Yang's, robust where
    there is more than one output.

    Args:
        A: of a step, shape (n, n).
        C: shape (p, n).
        poles: n eigenvalues, a complex one with its conjugate.

    Raises:
        ValueError: they cannot be placed.
    """
    # Much to import for those who place nothing.
    from scipy.signal import place_poles

    if unseen_mode(A, C, stable_too=True) is not None:
        raise ValueError("(Â, C) is not observable")
    placed = place_poles(A.T, (C @ A).T, np.array(poles), maxiter=100, rtol=1e-3)
    gain = np.ascontiguousarray(placed.gain_matrix.T)
    found = np.linalg.eigvals((np.eye(len(A)) - gain @ C) @ A)
    wanted = np.array(poles)
    off = np.abs(np.sort_complex(found) - np.sort_complex(wanted)).max()
    if not off < _MISPLACED:
        raise ValueError(f"rounding moves them by {off:.1g}; take poles farther apart")
    return gain

"""Observability of a discrete-time pair (A, C), and pole placement for an observer."""

import numpy as np

from noack.core.linear_systems import Matrix

_RANK_TOLERANCE = 1e-9
_POLE_TOLERANCE = 1e-6


def unobservable_mode(A: Matrix, C: Matrix, *, stable_too: bool = False) -> complex | None:
    """Return an eigenvalue of A whose mode does not appear in y = C x; None if there is none.

    The test of Popov, Belevitch and Hautus: the columns of [λI − A; C] are independent. By default
    only modes that do not decay are tested (detectability), with ``stable_too`` all modes
    (observability).
    """
    n = len(A)
    scale = max(float(np.linalg.norm(A, 2)), 1.0)
    scaled_C = C / max(float(np.linalg.norm(C, 2)), np.finfo(float).tiny)
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) < 1 - _RANK_TOLERANCE and not stable_too:
            continue
        tested = np.vstack([(eigenvalue * np.eye(n) - A) / scale, scaled_C])
        if np.linalg.svd(tested, compute_uv=False)[-1] < _RANK_TOLERANCE:
            return complex(eigenvalue)
    return None


def observer_gain(A: Matrix, C: Matrix, poles: tuple[complex, ...]) -> Matrix:
    """Return L, shape (n, p), for which (I − L C) A has these eigenvalues.

    L is the state feedback of the dual pair (Aᵀ, (CA)ᵀ), by the method of Tits and Yang, which is
    robust if there is more than one output. The poles are n eigenvalues, each complex one with its
    conjugate.

    Raises:
        ValueError: the eigenvalues cannot be placed.
    """
    # Imported here: observers with a given gain do not need this large module.
    from scipy.signal import place_poles

    if unobservable_mode(A, C, stable_too=True) is not None:
        raise ValueError("(Â, C) is not observable")
    placed = place_poles(A.T, (C @ A).T, np.array(poles), maxiter=100, rtol=1e-3)
    gain = np.ascontiguousarray(placed.gain_matrix.T)
    reached = np.linalg.eigvals((np.eye(len(A)) - gain @ C) @ A)
    error = np.abs(np.sort_complex(reached) - np.sort_complex(np.array(poles))).max()
    if not error < _POLE_TOLERANCE:
        raise ValueError(f"rounding moves them by {error:.1g}; take poles farther apart")
    return gain

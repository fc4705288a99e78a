"""Set points: states other than 0 at which a loop is to rest.

A set point is an equilibrium of the model, Âx_r + B̂u_r = 0. With u = K(x_c − x_r) + u_r both
models follow dx/dt = H(x − x_r). All statements about x, x_s and x_c then hold for x − x_r, x_s −
x_r and x_c − x_r, with a constant disturbance if the plant does not rest at x_r
(:mod:`noack.theory.certificates.conditions`).
"""

import numpy as np

from noack.core.linear_systems import Matrix, Vector

_ROUNDING = 1e-9  # largest Âx_r + B̂u_r that is taken as 0, relative to the larger term


def input_at(A: Matrix, B: Matrix, x_r: Vector) -> Vector:
    """Return u_r, (m,), with which a model rests at x_r, (n,): the solution of smallest norm.

    Raise ValueError, which names the nearest equilibrium, if it cannot rest there.
    """
    drift = A @ x_r
    u_r = np.asarray(np.linalg.lstsq(B, -drift, rcond=None)[0], dtype=np.float64)
    left = np.abs(drift + B @ u_r)
    largest = max(float(np.abs(drift).max()), float(np.abs(A).max() * np.abs(x_r).max()))
    if not x_r.any() or (np.isfinite(left).all() and left.max() <= _ROUNDING * largest):
        return u_r
    states = _equilibria(A, B)
    if not states.shape[1]:
        raise ValueError("no equilibrium of the model, which has none but 0: Âx + B̂u = 0")
    nearest = states @ (states.T @ x_r)
    shown = ", ".join(f"{value:.12g}" for value in np.where(np.abs(nearest) < 1e-12, 0.0, nearest))
    raise ValueError(
        f"no equilibrium of the model (Âx + B̂u = 0); those are a space of dimension "
        f"{states.shape[1]}, and the nearest one is [{shown}]"
    )


def _equilibria(A: Matrix, B: Matrix) -> Matrix:
    """Return an orthonormal basis of all x with Âx in the range of B̂, (n, k)."""
    blocked = A - B @ (np.linalg.pinv(B) @ A)
    _, sizes, directions = np.linalg.svd(blocked)
    scale = max(float(np.abs(A).max()), np.finfo(float).tiny)
    return np.ascontiguousarray(directions[(sizes > _ROUNDING * scale).sum() :].T)

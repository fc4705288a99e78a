"""Linearisation of a system about its operating point: ẋ ≈ A x + B u."""

import warnings
from collections.abc import Callable

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantSystem

_STEP_NS = 10_000_000
_OFF = 1e-4  # size of a deviation, in each coordinate's units
_SINGULAR = 1e-9
"""If the smallest singular value of the settled deviations is below this, x is not a state."""
_AHEAD = 10
_MISSED = 0.05
"""If A and B predict x some steps after any deviation with a larger relative error, x is not a
state."""


def linearise(
    system_at: Callable[[Vector], PlantSystem], n: int, m: int, *, settling_s: float = 0.0
) -> tuple[Matrix, Matrix]:
    """Linearise a system about x = 0, u = 0 from its response to small deviations.

    If a system has more states than x, its Jacobian does not describe the loop, which uses x only.
    So n + m small deviations of x(0) and u are applied, each with both signs. x is taken after the
    rest of the state has settled, and again a step of 10 ms later. Central differences give x(t +
    h) = Ad x(t) + Bd u. The matrix logarithm of [[Ad, Bd], [0, I]] divided by h gives A and B.

    Args:
        system_at: makes the system at an initial state, shape (n,).
        n: number of states.
        m: number of inputs.
        settling_s: settling time; 0 for a system with the state x.

    Returns:
        A and B, shapes (n, n) and (n, m), per second. They are NaN if the motion is not finite, or
        if x is not a state: its entries depend on each other, or do not determine the further
        motion.
    """
    settling = round(settling_s * 1e9 / _STEP_NS)
    ahead = _AHEAD if settling else 1

    def followed(x0: Vector, u: Vector) -> Matrix:
        system, met = system_at(x0), []
        for step in range(settling + ahead):
            met.append(system.x)
            system.advance(u, step * _STEP_NS, _STEP_NS)
        return np.array([*met, system.x])[[settling, settling + 1, -1]]

    before, after, later = (np.eye(n + m) for _ in range(3))
    for i in range(n + m):
        change = np.zeros(n + m)
        change[i] = _OFF
        plus, minus = (followed(sign * change[:n], sign * change[n:]) for sign in (1.0, -1.0))
        before[:n, i], after[:n, i], later[:n, i] = (plus - minus) / (2 * _OFF)
    unknown = np.full((n, n), np.nan), np.full((n, m), np.nan)
    if not (np.isfinite(before).all() and np.isfinite(later).all()):
        return unknown
    if np.linalg.svd(before, compute_uv=False)[-1] < _SINGULAR:
        return unknown
    step = after @ np.linalg.inv(before)
    missed = np.linalg.matrix_power(step, ahead) @ before - later
    sizes = np.maximum(*(np.linalg.norm(deviations[:n], axis=0) for deviations in (before, later)))
    if (np.linalg.norm(missed, axis=0) > _MISSED * sizes).any():
        return unknown
    with warnings.catch_warnings(action="ignore"):  # a singular matrix: the result is checked next
        from scipy.linalg import logm  # takes 0.2 s: linear plants do not need it

        generator = np.real(logm(step)) / (_STEP_NS * 1e-9)
    if not np.isfinite(generator).all():
        return unknown
    return generator[:n, :n], generator[:n, n:]

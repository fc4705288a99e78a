"""Minimisation over a gain without gradients: Nelder and Mead, Computer Journal 7(4), 1965."""

import math
from collections.abc import Callable

import numpy as np

from noack.core.linear_systems import Matrix, Vector


def nelder_mead(
    objective: Callable[[Vector], float],
    size: int,
    first_step: float,
    evaluations: int,
    tolerance: float = 1e-4,
    enough: float = -math.inf,
) -> Vector | None:
    """Minimise from 0 on; return the first point, (size,), whose value is below ``enough``, if any.

    Args:
        objective: to be minimised.
        size: number of unknowns.
        first_step: size of the first simplex.
        evaluations: largest number of evaluations.
        tolerance: difference of values at which the search ends.
        enough: the search ends at once at a value below this one.
    """
    from scipy.optimize import minimize  # slow to import

    good_points: list[Vector] = []

    def evaluate(point: Vector) -> float:
        value = objective(point)
        if value < enough:
            good_points.append(point.copy())
            raise StopIteration  # out of scipy's loop
        return value

    simplex = np.vstack([np.zeros(size), first_step * np.eye(size)])
    try:
        minimize(
            evaluate,
            np.zeros(size),
            method="Nelder-Mead",
            options={"maxfev": evaluations, "adaptive": True, "initial_simplex": simplex, "fatol": tolerance},
        )
    except StopIteration:
        return good_points[0]
    return None


def step_sizes(K: Matrix) -> Vector:
    """Return the unit of a search's steps of each entry of a gain."""
    return np.ravel(np.maximum(np.abs(K), 0.1 * np.abs(K).max(axis=1, keepdims=True)))

"""First exits from the unit ball, and maxima, of many polynomial curves at once.

Crossings are isolated as in :mod:`cosim.simulation.continuous.bernstein`, in array operations over
all curves. Nearly all curves cross at most once; the others are isolated one by one.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.continuous.bernstein import CurveBasis
from noack.core.linear_systems import Vector

Stack = NDArray[np.float64]

_ROUNDING = 16 * np.finfo(float).eps
_CROSSING_STEPS = 100
_PEAK_STEPS = 5
_SMALL_STEP = 1e-9
_FINEST = 2.0**-50


class CurveStack(CurveBasis):
    """Vector-valued polynomials of one degree on [0, 1], many at a time."""

    def first_exits(self, taylor: Stack) -> Vector:
        """Return each curve's first u in [0, 1] after which |y(u)| becomes > 1; NaN for none.

        The coefficients of y(u) = Σ_k ``taylor``[·, k] u^k have the shape (N, p + 1, n).
        """
        found = np.full(len(taylor), np.nan)
        if not len(taylor):
            return found
        inside = 1.0 - self.squares(taylor)
        tolerance = _ROUNDING * np.maximum(1.0, np.abs(inside).max(axis=1))
        outside = inside < -tolerance[:, None]
        clear = (np.abs(inside) > tolerance[:, None]).all(axis=1)
        changes = (outside[:, 1:] != outside[:, :-1]).sum(axis=1)
        once = clear & (changes == 1) & outside[:, -1]
        found[once] = _crossings(taylor[once])
        for i in np.flatnonzero(outside.any(axis=1) & ~once):
            u = self.first_exit(taylor[i])
            found[i] = np.nan if u is None else u
        return found

    def squares(self, taylor: Stack) -> Stack:
        """Return the Bernstein coefficients of |y(u)|² of each curve, (N, 2p + 1).

        The largest coefficient bounds |y|² on [0, 1]; the first and the last are |y|² at 0 and 1.
        """
        control = self.from_taylor @ taylor
        products = (control @ control.transpose(0, 2, 1)).reshape(len(taylor), -1)
        return np.asarray(products @ self.square.T)

    def halves(self, squares: Vector) -> tuple[Vector, Vector]:
        """Return the coefficients on [0, ½] and on [½, 1], each rescaled to [0, 1]."""
        left, right = np.split(self._halves @ squares, 2)
        return left, right


@lru_cache
def curve_stack(degree: int) -> CurveStack:
    """Return the cached basis of a degree."""
    return CurveStack(degree)


def powers(u: Vector, degree: int) -> Stack:
    """Return u^k for k = 0 … ``degree``, shape (N, p + 1)."""
    return np.vander(u, degree + 1, increasing=True)


def peak_squares(taylor: Stack, at: Vector, reach: float) -> Vector:
    """Return the maximum of |y|² within ``reach`` of u = ``at``, (N,), by Newton's method.

    |y|² has at most one maximum in this interval.
    """
    degree = taylor.shape[1] - 1
    first = np.arange(1.0, degree + 1)[:, None] * taylor[:, 1:]
    second = np.arange(1.0, degree)[:, None] * first[:, 1:]
    low, high = np.maximum(at - reach, 0.0), np.minimum(at + reach, 1.0)
    u = at
    for _ in range(_PEAK_STEPS):
        u_k = powers(u, degree)
        y = _values(u_k, taylor)
        slope, bend = _values(u_k[:, :-1], first), _values(u_k[:, :-2], second)
        rise = np.einsum("ai,ai->a", y, slope)
        curvature = np.einsum("ai,ai->a", slope, slope) + np.einsum("ai,ai->a", y, bend)
        # If |y|² is convex, its maximum is at an end of the interval.
        to_the_end = np.where(rise > 0, high, low) - u
        step = np.divide(-rise, curvature, out=to_the_end, where=curvature < 0)
        u = np.clip(u + step, low, high)
    y = _values(powers(u, degree), taylor)
    return np.asarray(np.einsum("ai,ai->a", y, y))


def _values(u_k: Stack, taylor: Stack) -> Stack:
    return np.asarray(np.einsum("ak,aki->ai", u_k, taylor))


def _crossings(taylor: Stack) -> Vector:
    """Solve |y(u)| = 1 for curves that cross once: Newton's method, bisection outside [0, 1]."""
    degree = taylor.shape[1] - 1
    first = np.arange(1.0, degree + 1)[:, None] * taylor[:, 1:]
    inside, outside = np.zeros(len(taylor)), np.ones(len(taylor))
    u = np.full(len(taylor), 0.5)
    for _ in range(_CROSSING_STEPS):
        u_k = powers(u, degree)
        y, slope = _values(u_k, taylor), _values(u_k[:, :-1], first)
        excess = np.einsum("ai,ai->a", y, y) - 1.0
        growth = 2.0 * np.einsum("ai,ai->a", y, slope)
        outside, inside = np.where(excess > 0, u, outside), np.where(excess > 0, inside, u)
        following = u - np.divide(excess, growth, out=np.full_like(u, np.inf), where=growth != 0)
        newton = (inside <= following) & (following <= outside)
        following = np.where(newton, following, (inside + outside) / 2)
        # The error after a step of Newton's method is about the square of the step.
        settled = newton & (np.abs(following - u) <= _SMALL_STEP * outside)
        settled |= outside - inside <= _FINEST * outside
        u = following
        if settled.all():
            break
    return u

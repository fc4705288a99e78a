"""Finds the first time at which a polynomial curve leaves the unit ball, in the Bernstein basis.

A polynomial on [0, 1] in the Bernstein basis lies in the convex hull of its coefficients. So a
curve does not leave the unit ball if all its control points lie in the ball, and a scalar
polynomial has no root if all its coefficients are positive. The number of its roots in (0, 1) is at
most the number of sign changes of its coefficients, and both numbers are equal modulo 2. Halving
the interval until there is at most one sign change isolates every simple root
(Vincent–Collins–Akritas). The basis is also the best conditioned one on [0, 1] (Farouki & Rajan,
1987): conversion from Taylor coefficients, product and halving only add multiples with positive
weights.
"""

from functools import cached_property, lru_cache
from math import comb

import numpy as np

from noack.core.linear_systems import Matrix, Vector

_ROUNDING = 16 * np.finfo(float).eps
_FINEST = 2.0**-52
_BISECTIONS = 60
_NEWTON_STEPS = 100
_NEWTON_RESOLUTION = 2.0**-50


class CurveBasis:
    """Vector-valued polynomials of one degree on [0, 1]."""

    def __init__(self, degree: int) -> None:
        self.degree = degree
        p = degree
        self.from_taylor: Matrix = np.array(
            [[comb(i, k) / comb(p, k) for k in range(p + 1)] for i in range(p + 1)]
        )
        """Control points = ``from_taylor`` @ Taylor coefficients, both of shape (p + 1, n)."""

    @cached_property
    def square(self) -> Matrix:
        """Bernstein coefficients of |b|² from all products bᵢ·bⱼ, shape (2p + 1, (p + 1)²)."""
        p = self.degree
        square = np.zeros((2 * p + 1, p + 1, p + 1))
        for i in range(p + 1):
            for j in range(p + 1):
                square[i + j, i, j] = comb(p, i) * comb(p, j) / comb(2 * p, i + j)
        return square.reshape(2 * p + 1, -1)

    @cached_property
    def _halves(self) -> Matrix:
        """Coefficients on [0, ½] above those on [½, 1] (de Casteljau), shape (4p + 2, 2p + 1)."""
        q = 2 * self.degree
        left = np.array([[comb(i, k) / 2.0**i for k in range(q + 1)] for i in range(q + 1)])
        return np.concatenate([left, left[::-1, ::-1]])

    def first_negative(self, coefficients: Vector) -> float | None:
        """Return the first u in [0, 1] after which a polynomial of degree 2p becomes negative.

        Rounding errors of the coefficients have the effects described in :meth:`first_exit`.

        Args:
            coefficients: in the Bernstein basis, shape (2p + 1,).
        """
        bracket = self._isolate(coefficients, _ROUNDING * float(np.abs(coefficients).max()))
        if bracket is None:
            return None
        low, high = bracket
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            if not low < middle < high:
                break
            value = coefficients @ self._polynomials(middle)
            low, high = (middle, high) if value >= 0 else (low, middle)
        return (low + high) / 2

    def _polynomials(self, u: float) -> Vector:
        """Values of the Bernstein polynomials of degree 2p, shape (2p + 1,)."""
        orders = np.arange(2 * self.degree + 1)
        values: Vector = self._binomials * u**orders * (1 - u) ** orders[::-1]
        return values

    @cached_property
    def _binomials(self) -> Vector:
        return np.array([float(comb(2 * self.degree, k)) for k in range(2 * self.degree + 1)])

    def first_exit(self, taylor: Matrix) -> float | None:
        """Return the first u in [0, 1] after which |y(u)| becomes > 1; None if there is none.

        An excursion is always found if its depth max |y|² − 1 exceeds the rounding error of the
        polynomial, about 1e-14. A shallower excursion (a tangency in floating point) may be missed.
        A curve that starts on the sphere and moves outward leaves the ball at u = 0.
        """
        control = self.from_taylor @ taylor
        inside = 1.0 - self.square @ (control @ control.T).ravel()
        tolerance = _ROUNDING * max(1.0, float(np.abs(inside).max()))
        bracket = self._isolate(inside, tolerance)
        return None if bracket is None else _refine(taylor, *bracket)

    def _isolate(self, inside: Vector, tolerance: float) -> tuple[float, float] | None:
        """Return an interval with the first exit and no other root, or the exit as both ends."""
        pending = [(0.0, 1.0, inside)]
        while pending:
            start, width, coefficients = pending.pop()
            signs = np.sign(coefficients) * (np.abs(coefficients) > tolerance)
            signs = signs[signs != 0]
            if not (signs < 0).any():
                continue
            if signs[0] < 0:
                return start, start
            single = np.count_nonzero(signs[1:] != signs[:-1]) == 1
            if width < _FINEST or (single and coefficients[-1] < -tolerance):
                return start, start + width
            left, right = np.split(self._halves @ coefficients, 2)
            pending += [(start + width / 2, width / 2, right), (start, width / 2, left)]
        return None


@lru_cache
def curve_basis(degree: int) -> CurveBasis:
    """Return the cached basis of a degree."""
    return CurveBasis(degree)


def _refine(taylor: Matrix, inside: float, outside: float) -> float:
    """Solve |y(u)| = 1 by Newton's method; bisect when a step leaves the bracket."""
    degree, n = len(taylor) - 1, taylor.shape[1]
    orders = np.arange(degree + 1.0)
    both = np.zeros((degree + 1, 2 * n))
    both[:, :n] = taylor
    both[:-1, n:] = orders[1:, None] * taylor[1:]
    u = (inside + outside) / 2
    for _ in range(_NEWTON_STEPS):
        values = u**orders @ both
        y, slope = values[:n], values[n:]
        excess, growth = float(y @ y) - 1.0, 2.0 * float(y @ slope)
        if excess > 0:
            outside = u
        else:
            inside = u
        following = u - excess / growth if growth else inside
        if not inside <= following <= outside:
            following = (inside + outside) / 2
        if abs(following - u) <= _NEWTON_RESOLUTION * outside:
            return following
        u = following
    return u

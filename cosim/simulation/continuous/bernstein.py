"""Finds the first time at which a polynomial becomes negative, in the Bernstein basis.

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


class CurveBasis:
    """Vector-valued polynomials of one degree on [0, 1].

    Args:
        degree: p of the curve; its squared norm has degree 2p.
    """

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

        It is always found if the polynomial becomes smaller than minus its rounding error. A
        shallower excursion (a tangency in floating point) may be missed.

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

        A curve that starts on the sphere and moves outward leaves the ball at u = 0.

        Args:
            taylor: coefficients of y(u) = Σ_k ``taylor``[k] u^k, shape (p + 1, n).
        """
        control = self.from_taylor @ taylor
        return self.first_negative(1.0 - self.square @ (control @ control.T).ravel())

    def _isolate(self, polynomial: Vector, tolerance: float) -> tuple[float, float] | None:
        """Return an interval with the first root and no other, or the root as both ends."""
        pending = [(0.0, 1.0, polynomial)]
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

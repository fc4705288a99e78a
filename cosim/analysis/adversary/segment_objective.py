"""The objective's value on a part of a run: the supremum of a norm, or the integral of its square.

Within a cell an output y of the loop is a polynomial of degree 18, up to rounding. The integral of
|y|² is computed by a Gauss–Legendre rule that is exact for this degree. The supremum is searched at
17 points. From every point that is higher than its neighbours and close to the maximum, Newton's
method refines it to rounding. The supremum can be missed only if |y|² has two maxima within 1/16 of
a cell. Then the slope has three zeros there, and |y|² varies by at most 1e-6 of its fourth
derivative, per cell.
"""

from typing import Protocol

import numpy as np

from cosim.analysis.adversary.polynomial_curves import Stack, peak_squares, powers
from cosim.simulation.continuous.exact_flow import DEGREE
from noack.core.linear_systems import Matrix, Vector

_POINTS = np.linspace(0.0, 1.0, 17)
_CLOSE = 0.95
"""A sampled |y|² next to a maximum is at least this share of it; lower points are not refined."""


class SegmentObjective(Protocol):
    """Returns the values of parts of cells.

    Args:
        z: scaled states at the start of cells, (N, 3n).
        u: the share of each cell that is evaluated, from its start, in (0, 1], (N,).
        known: results below these values may be inaccurate, (N,).
    """

    def __call__(self, z: Matrix, u: Vector, known: Vector) -> Vector:
        """Return the values, (N,)."""
        ...


class Supremum:
    """The supremum of |y| over parts of cells.

    Args:
        taylor: Taylor coefficients of y over a cell, (p + 1, q, 3n).
    """

    def __init__(self, taylor: Stack) -> None:
        self._curve = _OutputCurve(taylor, _POINTS)

    def __call__(self, z: Matrix, u: Vector, known: Vector) -> Vector:
        """See :class:`SegmentObjective`."""
        squares = self._curve.squares(z, u)
        highest = np.asarray(squares.max(axis=1))
        worth_it = _CLOSE * np.maximum(highest, np.maximum(known, 0.0) ** 2)
        around = np.pad(squares, ((0, 0), (1, 1)))
        peak = (squares >= around[:, :-2]) & (squares >= around[:, 2:])
        rows, points = np.nonzero(peak & (squares >= worth_it[:, None]))
        if len(rows):
            taylor = self._curve.taylor(z[rows], u[rows])
            np.maximum.at(highest, rows, peak_squares(taylor, _POINTS[points], _POINTS[1]))
        return np.asarray(np.sqrt(highest))


class SquareIntegral:
    """The integral of |y|² over parts of cells.

    Args:
        taylor: Taylor coefficients of y over a cell, (p + 1, q, 3n).
        width_s: width of a cell.
    """

    def __init__(self, taylor: Stack, width_s: float) -> None:
        points, weights = np.polynomial.legendre.leggauss(DEGREE + 1)
        self._curve = _OutputCurve(taylor, (points + 1) / 2)
        self._weights = width_s * weights / 2

    def __call__(self, z: Matrix, u: Vector, known: Vector) -> Vector:
        """See :class:`SegmentObjective`."""
        return np.asarray(u * (self._curve.squares(z, u) @ self._weights))


class _OutputCurve:
    """An output at fixed points of parts of cells."""

    def __init__(self, taylor: Stack, points: Vector) -> None:
        self._q, self._points = taylor.shape[1], len(points)
        self._at_points = powers(points, DEGREE)
        self._taylor = columns(taylor)
        self._whole = columns(np.tensordot(self._at_points, taylor, 1))

    def taylor(self, z: Matrix, u: Vector) -> Stack:
        """Return y's coefficients over [0, u] of the cell, rescaled to [0, 1]; (N, p + 1, q)."""
        whole = (z @ self._taylor).reshape(len(z), DEGREE + 1, self._q)
        return np.asarray(whole * powers(u, DEGREE)[:, :, None])

    def squares(self, z: Matrix, u: Vector) -> Stack:
        """Return |y|² at the points, (N, points)."""
        y = np.empty((len(z), self._points, self._q))
        whole = u == 1.0
        y[whole] = (z[whole] @ self._whole).reshape(-1, self._points, self._q)
        y[~whole] = self._at_points @ self.taylor(z[~whole], u[~whole])
        return np.asarray(np.einsum("aki,aki->ak", y, y))


def columns(terms: Stack) -> Matrix:
    """Return terms (p, q, N) as a matrix (N, p q), the right factor for states in rows."""
    return np.ascontiguousarray(terms.reshape(-1, terms.shape[2]).T)

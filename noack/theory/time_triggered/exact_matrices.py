"""Matrices with bounds of rounding, in double precision.

:class:`IntervalMatrix`: entries are known up to a radius. A computed product of k terms differs
from the exact one by at most k u/(1 − k u) times the product of the absolute values, u = 2⁻⁵³, in
whichever order it is summed (Higham, *Accuracy and Stability of Numerical Algorithms*, section
3.1). The bounds themselves are rounded too; they are enlarged by more than that can be, and by more
than underflow can hide. Stacks of thousands of matrices are one product; for single ones there are balls
(:mod:`noack.core.balls`), of which :func:`enclosing` makes such a matrix.
"""

from typing import NamedTuple

import numpy as np
from flint import arb_mat
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix

_UNIT_ROUNDOFF = 2.0**-53
"""u, the largest relative error of an operation in double precision."""
ENLARGED = 1 + 2.0**-40
"""Exceeds the rounding of a computed radius of up to 8,000 terms."""
_UNDERFLOW = 1e-290
"""Exceeds what underflow hides of a term."""
_LARGEST_DOUBLE = int(np.finfo(np.float64).max)
"""The largest number in double precision."""


class IntervalMatrix(NamedTuple):
    """All matrices, or stacks of matrices, that differ from ``middle`` by at most ``radius``."""

    middle: Matrix
    radius: Matrix
    """Not negative, of the shape of ``middle``."""

    def __matmul__(self, other: "IntervalMatrix") -> "IntervalMatrix":
        """Enclose the products."""
        left, right = np.abs(self.middle), np.abs(other.middle)
        terms = left.shape[-1] + 4
        radius = left @ (other.radius + terms * _UNIT_ROUNDOFF * right) + self.radius @ (right + other.radius)
        return IntervalMatrix(self.middle @ other.middle, radius * ENLARGED + terms * _UNDERFLOW)

    def __sub__(self, other: "IntervalMatrix") -> "IntervalMatrix":
        """Enclose the differences."""
        middle = self.middle - other.middle
        radius = self.radius + other.radius + 2 * _UNIT_ROUNDOFF * np.abs(middle)
        return IntervalMatrix(middle, radius * ENLARGED + _UNDERFLOW)

    def scaled(self, exponent: int | NDArray[np.int64]) -> "IntervalMatrix":
        """Return the matrices times 2^exponent, which may differ from entry to entry."""
        return IntervalMatrix(np.ldexp(self.middle, exponent), np.ldexp(self.radius, exponent) + _UNDERFLOW)

    @property
    def magnitude(self) -> Matrix:
        """Upper bounds of the absolute values."""
        bound: NDArray[np.float64] = (np.abs(self.middle) + self.radius) * ENLARGED
        return bound

    @property
    def transposed(self) -> "IntervalMatrix":
        """The transposed matrices."""
        return IntervalMatrix(self.middle.swapaxes(-1, -2), self.radius.swapaxes(-1, -2))

    def at(self, numbers: NDArray[np.int64] | NDArray[np.bool_]) -> "IntervalMatrix":
        """Return some matrices of a stack."""
        return IntervalMatrix(self.middle[numbers], self.radius[numbers])


def exactly(matrix: Matrix) -> IntervalMatrix:
    """Return a matrix that is known exactly."""
    return IntervalMatrix(matrix, np.zeros_like(matrix))


def enclosing(balls: arb_mat) -> IntervalMatrix:
    """Return a matrix of balls in double precision, with its error.

    Raises:
        OverflowError: an entry, or its error, is beyond double precision.
    """
    if not all(abs(ball).upper() < _LARGEST_DOUBLE for ball in balls.entries()):
        raise OverflowError
    pairs = [(float(ball.mid()), float(ball.rad().upper())) for ball in balls.entries()]
    middle, errors = np.moveaxis(np.array(pairs).reshape(balls.nrows(), balls.ncols(), 2), -1, 0)
    return IntervalMatrix(middle, np.abs(middle) * 2.0**-52 + errors * (1 + 1e-9) + 1e-290)


def inverse(matrix: Matrix) -> IntervalMatrix | None:
    """Enclose the inverse of a matrix; None if that fails."""
    try:
        return enclosing(arb_mat(matrix.tolist()).inv())
    except (ZeroDivisionError, OverflowError):
        return None

"""Matrices whose entries are known up to a radius, with products that include all rounding.

A computed product of k terms differs from the exact one by at most k u/(1 − k u) times the product
of the absolute values, u = 2⁻⁵³, in whichever order it is summed (Higham, *Accuracy and Stability
of Numerical Algorithms*, section 3.1). The bounds themselves are rounded too; they are enlarged by
more than that can be, and by more than underflow can hide.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix

_UNIT = 2.0**-53
_ENLARGED = 1 + 2.0**-40
_UNDERFLOW = 1e-290


class IntervalMatrix(NamedTuple):
    """All matrices, or stacks of matrices, that differ from ``middle`` by at most ``radius``."""

    middle: Matrix
    radius: Matrix
    """Not negative, of the shape of ``middle``."""

    def __matmul__(self, other: "IntervalMatrix") -> "IntervalMatrix":
        """Enclose the products."""
        size, others = np.abs(self.middle), np.abs(other.middle)
        terms = size.shape[-1] + 4
        radius = size @ (other.radius + terms * _UNIT * others) + self.radius @ (
            others + other.radius
        )
        return IntervalMatrix(self.middle @ other.middle, radius * _ENLARGED + terms * _UNDERFLOW)

    def __sub__(self, other: "IntervalMatrix") -> "IntervalMatrix":
        """Enclose the differences."""
        middle = self.middle - other.middle
        radius = self.radius + other.radius + 2 * _UNIT * np.abs(middle)
        return IntervalMatrix(middle, radius * _ENLARGED + _UNDERFLOW)

    def scaled(self, exponent: int) -> "IntervalMatrix":
        """Return the matrices times 2^exponent."""
        return IntervalMatrix(
            np.ldexp(self.middle, exponent), np.ldexp(self.radius, exponent) + _UNDERFLOW
        )

    @property
    def magnitude(self) -> Matrix:
        """Upper bounds of the absolute values."""
        bound: NDArray[np.float64] = (np.abs(self.middle) + self.radius) * _ENLARGED
        return bound


def exactly(matrix: Matrix) -> IntervalMatrix:
    """Return a matrix that is known exactly."""
    return IntervalMatrix(matrix, np.zeros_like(matrix))


def inverse(matrix: Matrix) -> IntervalMatrix | None:
    """Enclose the inverse of an invertible matrix, (n, n); None if that fails.

    With an approximate inverse R and E = I − R M: M⁻¹ − R = E M⁻¹, so M⁻¹ differs from R by at most
    ‖E‖∞/(1 − ‖E‖∞) times the largest entry of each column of R.
    """
    try:
        approximate: Matrix = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    product = exactly(approximate) @ exactly(matrix)
    defect = float((exactly(np.eye(len(matrix))) - product).magnitude.sum(axis=1).max())
    if not defect * _ENLARGED < 0.5:
        return None
    columns = np.abs(approximate).max(axis=0) * (defect / (1 - defect)) * _ENLARGED**4
    return IntervalMatrix(approximate, np.broadcast_to(columns, matrix.shape).copy())

"""Matrices with bounds of rounding: enclosures in double precision, and balls of 512 bits.

:class:`IntervalMatrix`: entries are known up to a radius. A computed product of k terms differs
from the exact one by at most k u/(1 − k u) times the product of the absolute values, u = 2⁻⁵³, in
whichever order it is summed (Higham, *Accuracy and Stability of Numerical Algorithms*, section
3.1). The bounds themselves are rounded too; they are enlarged by more than that can be, and by more
than underflow can hide. Stacks of thousands of matrices are one product.

:class:`BallMatrix`: a matrix of balls (python-flint). Products of hundreds of steps are computed with them,
so that what remains is the rounding of the result to double precision.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat, ctx, fmpq
from numpy.typing import NDArray

from netem.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix

_UNIT_ROUNDOFF = 2.0**-53
"""u, the largest relative error of an operation in double precision."""
ENLARGED = 1 + 2.0**-40
"""Exceeds the rounding of a computed radius of up to 8,000 terms."""
_UNDERFLOW = 1e-290
"""Exceeds what underflow hides of a term."""
_BITS = 512
"""Of a ball's midpoint: products of hundreds of steps lose far fewer."""
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


def inverse(matrices: Matrix) -> IntervalMatrix | None:
    """Enclose the inverses of invertible matrices, (…, n, n); None if that fails for one of them.

    With an approximate inverse R and E = I − R M: M⁻¹ − R = E M⁻¹, so M⁻¹ differs from R by at most
    ‖E‖∞/(1 − ‖E‖∞) times the largest entry of each column of R.
    """
    try:
        approximate: Matrix = np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    errors = exactly(np.eye(matrices.shape[-1])) - exactly(approximate) @ exactly(matrices)
    defects = errors.magnitude.sum(axis=-1).max(axis=-1)
    if not (defects * ENLARGED < 0.5).all():
        return None
    shares = (defects / (1 - defects))[..., None, None]
    columns = np.abs(approximate).max(axis=-2, keepdims=True) * shares * ENLARGED**4
    return IntervalMatrix(approximate, np.broadcast_to(columns, matrices.shape).copy())


@dataclass(frozen=True)
class BallMatrix:
    """All matrices whose entries are in balls, with midpoints of 512 bits."""

    balls: arb_mat

    def __matmul__(self, other: "BallMatrix") -> "BallMatrix":
        """Return the product."""
        with ctx.workprec(_BITS):
            return BallMatrix(self.balls * other.balls)

    def then(self, later: "BallMatrix") -> "BallMatrix":
        """Return the product that applies this matrix first, and then a later one."""
        return later @ self

    def rows(self, numbers: slice) -> "BallMatrix":
        """Return some of the rows."""
        return BallMatrix(arb_mat(self.balls.tolist()[numbers]))

    def interval(self) -> IntervalMatrix:
        """Return the matrix in double precision, with its error."""
        with ctx.workprec(_BITS):
            pairs = [(float(ball.mid()), float(ball.rad().upper())) for ball in self.balls.entries()]
        shape = self.balls.nrows(), self.balls.ncols(), 2
        middle, errors = np.moveaxis(np.array(pairs).reshape(shape), -1, 0)
        return IntervalMatrix(middle, np.abs(middle) * 2.0**-52 + errors * (1 + 1e-9) + 1e-290)


def fixed(matrix: Matrix) -> BallMatrix:
    """Return a matrix of finite doubles, exactly."""
    return BallMatrix(arb_mat(matrix.tolist()))


def stacked(*parts: BallMatrix) -> BallMatrix:
    """Return matrices on top of each other."""
    return BallMatrix(arb_mat([row for part in parts for row in part.balls.tolist()]))


def exponential(generator: Matrix, dt: int, parts: int = 1) -> BallMatrix:
    """Return e^{G dt}, with G per second.

    Args:
        generator: G, (n, n).
        dt: in parts of a nanosecond.
        parts: their number in a nanosecond.

    Raises:
        OverflowError: an entry, or its error, is beyond double precision.
    """
    with ctx.workprec(_BITS):
        found = (arb_mat(generator.tolist()) * arb(fmpq(dt, parts * NS_PER_S))).exp()
        if not all(abs(entry).upper() < _LARGEST_DOUBLE for entry in found.entries()):
            raise OverflowError
        return BallMatrix(found)

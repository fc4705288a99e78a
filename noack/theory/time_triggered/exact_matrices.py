"""Matrices with bounds of rounding: enclosures in double precision, and 384 binary digits after the point.

:class:`IntervalMatrix`: entries are known up to a radius. A computed product of k terms differs
from the exact one by at most k u/(1 − k u) times the product of the absolute values, u = 2⁻⁵³, in
whichever order it is summed (Higham, *Accuracy and Stability of Numerical Algorithms*, section
3.1). The bounds themselves are rounded too; they are enlarged by more than that can be, and by more
than underflow can hide. Stacks of thousands of matrices are one product.

:class:`FixedPointMatrix`: 384 binary digits after the point, with a bound of the error. Products of
hundreds of steps are computed with them, so that what remains is the rounding of the result to
double precision. The entries are Python integers, in units of 2⁻³⁸⁴.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix

_UNIT_ROUNDOFF = 2.0**-53
"""u, the largest relative error of an operation in double precision."""
ENLARGED = 1 + 2.0**-40
"""Exceeds the rounding of a computed radius of up to 8,000 terms."""
_UNDERFLOW = 1e-290
"""Exceeds what underflow hides of a term."""
_DIGITS = 384
"""Binary digits after the point: products of hundreds of steps lose far fewer."""
_ONE = 1 << _DIGITS
"""The number 1 in these units."""
_LARGEST_DOUBLE = int(np.finfo(np.float64).max)
"""The largest number in double precision."""
_TAYLOR_TERMS = 60
"""Terms of Taylor's series of an exponential with a norm up to 1/16: the remainder is below 2⁻⁵⁰⁰."""


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
class FixedPointMatrix:
    """A matrix; each entry differs from the exact one by at most its error.

    One error for all entries would grow in every product, although the products do not.
    """

    entries: NDArray[np.object_]
    """Integers in units of 2⁻³⁸⁴, an array of objects."""
    errors: NDArray[np.object_]
    """In the same unit, of the same shape."""

    def __matmul__(self, other: "FixedPointMatrix") -> "FixedPointMatrix":
        """Return the product."""
        errors = abs(self.entries) @ other.errors + self.errors @ (abs(other.entries) + other.errors)
        return FixedPointMatrix((self.entries @ other.entries) >> _DIGITS, (errors >> _DIGITS) + 2)

    def then(self, later: "FixedPointMatrix") -> "FixedPointMatrix":
        """Return the product that applies this matrix first, and then a later one."""
        return later @ self

    def __add__(self, other: "FixedPointMatrix") -> "FixedPointMatrix":
        """Return the sum."""
        return FixedPointMatrix(self.entries + other.entries, self.errors + other.errors)

    def rows(self, numbers: slice | list[int]) -> "FixedPointMatrix":
        """Return some of the rows."""
        return FixedPointMatrix(self.entries[numbers], self.errors[numbers])

    def interval(self) -> IntervalMatrix:
        """Return the matrix in double precision, with its error."""
        # A quotient of integers is rounded correctly.
        middle, errors = (np.asarray(part / _ONE, np.float64) for part in (self.entries, self.errors))
        return IntervalMatrix(middle, np.abs(middle) * 2.0**-52 + errors * (1 + 1e-9) + 1e-290)


def fixed(matrix: Matrix) -> FixedPointMatrix:
    """Return a matrix of finite doubles; digits beyond the last are dropped."""
    entries = np.empty(matrix.shape, dtype=object)
    for index, value in np.ndenumerate(matrix):
        numerator, denominator = float(value).as_integer_ratio()
        entries[index] = numerator * _ONE // denominator
    return FixedPointMatrix(entries, np.full_like(entries, 1))


def stacked(*parts: FixedPointMatrix) -> FixedPointMatrix:
    """Return matrices on top of each other."""
    entries = np.concatenate([part.entries for part in parts])
    return FixedPointMatrix(entries, np.concatenate([part.errors for part in parts]))


def exponential(generator: Matrix, dt: int, parts: int = 1) -> FixedPointMatrix:
    """Return e^{G dt}, with G per second, by Taylor's series and repeated squaring.

    Args:
        generator: G, (n, n).
        dt: in parts of a nanosecond.
        parts: their number in a nanosecond.

    Raises:
        OverflowError: an entry, or its error, is beyond double precision.
    """
    whole, per_s = fixed(generator), parts * NS_PER_S
    scaled = [value * dt // per_s for value in whole.entries.ravel()]
    norm = sum(abs(value) for value in scaled) or 1
    halvings = max(norm.bit_length() - _DIGITS + 4, 0)
    entries = np.empty(generator.shape, dtype=object)
    entries.ravel()[:] = [value >> halvings for value in scaled]
    step = FixedPointMatrix(entries, np.full_like(entries, dt // per_s + 3))
    total = term = fixed(np.eye(len(generator)))
    for order in range(1, _TAYLOR_TERMS):
        term = term @ step
        term = FixedPointMatrix(term.entries // order, term.errors // order + 2)
        total = total + term
    total = FixedPointMatrix(total.entries, total.errors + 1)
    for _ in range(halvings):
        total = total @ total
        if max(abs(total.entries).max(), total.errors.max()) >> _DIGITS > _LARGEST_DOUBLE:
            raise OverflowError  # further squares would take more and more memory
    return total

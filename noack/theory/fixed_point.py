"""Matrices of 384 binary digits after the point, with a bound of their error.

Products of hundreds of steps are computed with them, so that what remains is the rounding of the
result to double precision. The entries are Python integers, in units of 2⁻³⁸⁴.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix
from noack.theory.interval_matrix import IntervalMatrix

_DIGITS = 384
_ONE = 1 << _DIGITS
_TERMS = 60
"""Of Taylor's series of an exponential with a norm up to 1/16: the remainder is below 2⁻⁵⁰⁰."""


@dataclass(frozen=True)
class FixedPointMatrix:
    """A matrix; each entry differs from the exact one by at most ``error``."""

    entries: Any
    """Integers in units of 2⁻³⁸⁴, an array of objects."""
    error: int = 0
    """In the same unit."""

    def __matmul__(self, other: "FixedPointMatrix") -> "FixedPointMatrix":
        """Return the product."""
        rows = int(abs(self.entries).sum(axis=1).max())
        columns = int(abs(other.entries).sum(axis=0).max())
        crossed = self.error * other.error * len(other.entries)
        error = ((rows * other.error + self.error * columns + crossed) >> _DIGITS) + 2
        return FixedPointMatrix((self.entries @ other.entries) >> _DIGITS, error)

    def __add__(self, other: "FixedPointMatrix") -> "FixedPointMatrix":
        """Return the sum."""
        return FixedPointMatrix(self.entries + other.entries, self.error + other.error)

    def rows(self, which: slice | list[int]) -> "FixedPointMatrix":
        """Return some of the rows."""
        return FixedPointMatrix(self.entries[which], self.error)

    def interval(self) -> IntervalMatrix:
        """Return the matrix in double precision, with its error."""
        middle = np.array(
            [[entry / _ONE for entry in row] for row in self.entries.tolist()], dtype=np.float64
        ).reshape(self.entries.shape)
        # A quotient of integers is rounded correctly.
        return IntervalMatrix(
            middle, np.abs(middle) * 2.0**-52 + (self.error / _ONE) * (1 + 1e-9) + 1e-290
        )


def fixed(matrix: Matrix) -> FixedPointMatrix:
    """Return a matrix of finite doubles; digits beyond the last are dropped."""
    entries = np.empty(matrix.shape, dtype=object)
    for place, value in np.ndenumerate(matrix):
        numerator, denominator = float(value).as_integer_ratio()
        entries[place] = numerator * _ONE // denominator
    return FixedPointMatrix(entries, 1)


def stacked(*parts: FixedPointMatrix) -> FixedPointMatrix:
    """Return matrices on top of each other."""
    entries = np.concatenate([part.entries for part in parts])
    return FixedPointMatrix(entries, max(part.error for part in parts))


def power(matrix: FixedPointMatrix, exponent: int) -> FixedPointMatrix:
    """Return a power by repeated squaring; the exponent is not negative."""
    result = fixed(np.eye(len(matrix.entries)))
    while exponent:
        if exponent & 1:
            result = matrix @ result
        exponent >>= 1
        if exponent:
            matrix = matrix @ matrix
    return result


def exponential(generator: Matrix, dt_ns: int) -> FixedPointMatrix:
    """Return e^{G dt}, with G per second, by Taylor's series and repeated squaring."""
    whole = fixed(generator)
    scaled = [value * dt_ns // NS_PER_S for value in whole.entries.ravel()]
    norm = sum(abs(value) for value in scaled) or 1
    halvings = max(norm.bit_length() - _DIGITS + 4, 0)
    entries = np.empty(generator.shape, dtype=object)
    entries.ravel()[:] = [value >> halvings for value in scaled]
    step = FixedPointMatrix(entries, dt_ns // NS_PER_S + 3)
    total = term = fixed(np.eye(len(generator)))
    for order in range(1, _TERMS):
        term = term @ step
        term = FixedPointMatrix(term.entries // order, term.error // order + 2)
        total = total + term
    total = FixedPointMatrix(total.entries, total.error + 1)
    return power(total, 1 << halvings)

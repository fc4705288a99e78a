"""Numbers of a file, as JSON has them: decimals, quotients "p/q", and intervals that are rounded outwards."""

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from flint import arb, arb_mat, fmpq

from noack.proof.no_document import NoDocumentError

_MOST_DENOMINATOR = 10**12
_SMALL, _ROUNDED = 1e-14, 1e-12
"""Shares below which an eigenvalue is 0, and by which others are rounded outwards."""
Number = int | float | str
Fractions = list[list[Fraction]]
"""The rows of an exact matrix."""


def exact(value: arb | fmpq | float | int) -> Number:
    """Return an exact number.

    A number that is a double is written as its shortest decimal, as a scenario has it. The decimal may
    differ from the double by half a unit in the last place, and is what the document says.
    """
    fraction = to_fraction(value)
    if fraction.denominator == 1:
        return int(fraction)
    try:
        nearest = float(fraction)
    except OverflowError:
        return f"{fraction.numerator}/{fraction.denominator}"
    if Fraction(repr(nearest)) == fraction or Fraction(nearest) == fraction:
        return nearest
    return f"{fraction.numerator}/{fraction.denominator}"


def entry(value: arb | fmpq) -> Number | list[float]:
    """Return an exact number, or the interval of a ball, rounded outwards."""
    if value == 0:  # most entries are
        return 0
    if not isinstance(value, arb) or value.is_exact():
        return exact(value)
    low, high = (to_fraction(end) for end in (value.lower(), value.upper()))
    return [below(low), above(high)]


def above(value: Fraction) -> float:
    """Return a float whose decimal is at least a value.

    Raises:
        NoDocumentError: the value is beyond all floats, as e^(−As) of a stiff model and an old input.
    """
    try:
        found = float(value)
    except OverflowError:
        raise NoDocumentError("a number of its document would be larger than 1e308") from None
    while Fraction(repr(found)) < value:
        found = math.nextafter(found, math.inf)
    return found


def below(value: Fraction) -> float:
    """Return a float whose decimal is at most a value."""
    return -above(-value)


def least_above(value: arb) -> float:
    """Return a float whose decimal is at least all numbers of a ball."""
    return above(to_fraction(value.upper()))


def to_fraction(value: arb | fmpq | float | int) -> Fraction:
    """Return an exact number as a fraction.

    Raises:
        ValueError: it is a ball.
    """
    if isinstance(value, arb):
        if not value.is_exact():
            raise ValueError("a ball is no exact number")
        value = value.fmpq()
    if isinstance(value, fmpq):
        return Fraction(int(value.p), int(value.q))
    return Fraction(value)


def simplest(value: arb) -> Fraction:
    """Return the fraction with a small denominator that a narrow ball stands for.

    Raises:
        ValueError: there is none.
    """
    if value.is_exact():
        return to_fraction(value)
    found = to_fraction(value.mid()).limit_denominator(_MOST_DENOMINATOR)
    if not value.contains(arb(fmpq(found.numerator, found.denominator))):
        raise ValueError(f"no fraction with a small denominator is in {value}")
    return found


def as_written(value: float) -> Fraction:
    """Return the decimal of a float, as a file has it."""
    return Fraction(repr(value))


def quotient(value: Fraction) -> Number:
    """Return a fraction, as a decimal where it has a short one."""
    return exact(fmpq(value.numerator, value.denominator))


def matrix(M: arb_mat) -> list[list[Number | list[float]]]:
    """Return a matrix."""
    return [[entry(M[i, j]) for j in range(M.ncols())] for i in range(M.nrows())]


def squares_of(Q: arb_mat, used: Sequence[int], *, is_above: bool) -> list[tuple[list[Number], bool]]:
    """Return rows R with Q ≤ Σ ±|Rz|² for some of the coordinates of z, each with whether its sign is plus.

    ``is_above``: else Q ≥ the sum.
    """
    M = np.array([[float(Q[i, j].mid()) for j in used] for i in used])
    values, vectors = np.linalg.eigh(M)
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        if abs(value) > _SMALL * np.abs(values).max():
            outwards = 1 + (_ROUNDED if (value > 0) == is_above else -_ROUNDED)
            row = np.where(np.abs(vector) > _SMALL, math.sqrt(abs(value) * outwards) * vector, 0.0)
            found.append(([exact(float(entry)) for entry in row], bool(value > 0)))
    return found


def product(left: Fractions, right: Fractions) -> Fractions:
    """Return the product of two exact matrices."""
    columns = [*zip(*right, strict=True)]
    return [
        [sum((a * b for a, b in zip(row, column, strict=True)), Fraction()) for column in columns]
        for row in left
    ]


def written(rows: Fractions) -> list[list[Number]]:
    """Return an exact matrix as a file has it."""
    return [[quotient(entry) for entry in row] for row in rows]

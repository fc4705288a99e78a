"""Values of the settings of a loop: names, rates, vectors, matrices."""

import json
import math
from collections.abc import Iterable
from fractions import Fraction
from typing import Annotated

from pydantic import AfterValidator, Field, FiniteFloat

from netem.core.clock import NS_PER_S
from netem.core.periods import RATE_ROUNDING, period_of
from noack.core.linear_systems import Matrix
from noack.protocol.wire_format import MAX_DIMENSION

_LONGEST_NAME = 64


def require_name(text: str) -> str:
    """Return the name of an output, a state or an input, or its unit.

    Raise ValueError unless it can stand in a line of text and in the legend of a figure, which reads
    text between two $ as a formula.
    """
    if len(text) > _LONGEST_NAME or not text.isprintable() or text.strip() != text or "$" in text:
        raise ValueError(
            f"names have at most {_LONGEST_NAME} printable characters, no $, and no space at an end"
        )
    return text


Name = Annotated[str, Field(min_length=1, max_length=_LONGEST_NAME), AfterValidator(require_name)]
"""How outputs, states and inputs are called in texts and figures."""
Unit = Annotated[str, Field(max_length=24), AfterValidator(require_name)]


def _with_period(rate_hz: float) -> float:
    """Raise ValueError if steps at this rate would drift from their times."""
    if abs(1 - (exact := period_of(rate_hz).exact * Fraction(rate_hz) / NS_PER_S)) > RATE_ROUNDING:
        raise ValueError(
            "the period is too near to a whole number of nanoseconds; "
            f"the nearest such rate is {float(rate_hz / exact)!r}"
        )
    return rate_hz


RateHz = Annotated[FiniteFloat, Field(ge=1e-6, le=100_000), AfterValidator(_with_period)]
"""A run has at most 1e7 s: the times of its steps fit into 64 bits."""
Row = Annotated[tuple[FiniteFloat, ...], Field(min_length=1, max_length=MAX_DIMENSION)]
"""A vector."""
MatrixRows = Annotated[tuple[Row, ...], Field(min_length=1, max_length=MAX_DIMENSION)]
"""A matrix by rows."""

_LONGEST_SHOWN = 60
"""Longest transposed matrix that a message shows, in characters."""


def _not_negative(title: str, most: float = math.inf) -> AfterValidator:
    """Require entries from 0 to ``most``; the squares of larger ones might overflow."""

    def check(row: tuple[float, ...]) -> tuple[float, ...]:
        if any(entry < 0 for entry in row):
            raise ValueError(f"{title} cannot be negative")
        if any(entry > most for entry in row):
            raise ValueError(f"{title} can be {most:g} at most")
        return row

    return AfterValidator(check)


Deviations = Annotated[Row, _not_negative("standard deviations", 1e100)]
"""Standard deviations, entry by entry."""
Bounds = Annotated[Row, _not_negative("bounds", 1e100)]
"""Largest absolute values, entry by entry."""
HalfWidths = Annotated[Row, _not_negative("half-widths")]
"""Half-widths of intervals, entry by entry."""
HalfWidthRows = Annotated[tuple[HalfWidths, ...], Field(min_length=1, max_length=MAX_DIMENSION)]


def rows_of(matrix: Matrix) -> tuple[tuple[float, ...], ...]:
    """Return a matrix by rows."""
    return tuple(map(tuple, matrix.tolist()))


def shape(rows: tuple[tuple[float, ...], ...], key: str) -> tuple[int, int]:
    """Return (rows, columns) of a matrix; raise ValueError if its rows differ in length."""
    widths = {len(row) for row in rows}
    if len(widths) > 1:
        raise ValueError(f"{key}: all rows need the same length, found lengths {sorted(widths)}")
    return len(rows), widths.pop()


def require_shape(
    rows: tuple[tuple[float, ...], ...] | None, key: str, expected: tuple[int, int], reason: str
) -> None:
    """Raise ValueError if a matrix is given and does not have the expected shape."""
    if rows is None:
        return
    actual = shape(rows, key)
    if actual != expected:
        raise ValueError(
            f"{key}: expected {expected[0]} x {expected[1]} ({reason}), found {actual[0]} x {actual[1]}"
            + (_transposed(rows) if actual == expected[::-1] else "")
        )


def _transposed(rows: Iterable[Iterable[float]]) -> str:
    transposed = json.dumps([list(column) for column in zip(*rows, strict=True)])
    return "; looks transposed" + (f": try {transposed}" if len(transposed) <= _LONGEST_SHOWN else "")


def require_length(row: tuple[object, ...] | None, key: str, expected: int, reason: str) -> None:
    """Raise ValueError if a vector or list of names is given and has another length."""
    if row is not None and len(row) != expected:
        raise ValueError(f"{key}: expected {expected} entries ({reason}), found {len(row)}")


def require_distinct(names: tuple[str, ...] | None, key: str) -> None:
    """Raise ValueError if a name occurs twice in a list of names that is given."""
    for name in names or ():
        if (names or ()).count(name) > 1:
            given = ", ".join(names or ())
            raise ValueError(f"{key}: {name} occurs more than once in {given}; give each a name of its own")

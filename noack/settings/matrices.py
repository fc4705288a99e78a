"""Vectors and matrices as in a scenario file, and checks of their shapes and values."""

import json
from collections.abc import Iterable
from typing import Annotated

from pydantic import Field, FiniteFloat

from noack.core.linear_systems import Matrix
from noack.protocol.wire_format import MAX_DIMENSION

Row = Annotated[tuple[FiniteFloat, ...], Field(min_length=1, max_length=MAX_DIMENSION)]
"""A vector."""
Rows = Annotated[tuple[Row, ...], Field(min_length=1, max_length=MAX_DIMENSION)]
"""A matrix by rows."""

_LARGEST = 1e100
_LONGEST_SHOWN = 60


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
    rows: tuple[tuple[float, ...], ...] | None, key: str, expected: tuple[int, int], why: str
) -> None:
    """Raise ValueError if a matrix is given and does not have the expected shape."""
    if rows is None:
        return
    found = shape(rows, key)
    if found != expected:
        raise ValueError(
            f"{key}: expected {expected[0]} x {expected[1]} ({why}), found {found[0]} x {found[1]}"
            + (_transposed(rows) if found == expected[::-1] else "")
        )


def _transposed(rows: Iterable[Iterable[float]]) -> str:
    other = json.dumps([list(column) for column in zip(*rows, strict=True)])
    return "; looks transposed" + (f": try {other}" if len(other) <= _LONGEST_SHOWN else "")


def require_length(row: tuple[object, ...] | None, key: str, expected: int, why: str) -> None:
    """Raise ValueError if a vector or list of names is given and has another length."""
    if row is not None and len(row) != expected:
        raise ValueError(f"{key}: expected {expected} entries ({why}), found {len(row)}")


def require_non_negative(row: tuple[float, ...], key: str, what: str = "half-widths") -> None:
    """Raise ValueError if an entry of a vector is negative; ``what`` names the entries."""
    if any(entry < 0 for entry in row):
        raise ValueError(f"{key}: {what} cannot be negative")


def require_squares(row: tuple[float, ...], key: str, what: str) -> None:
    """Raise ValueError if an entry is negative, or its square overflows."""
    require_non_negative(row, key, what)
    if any(entry > _LARGEST for entry in row):
        raise ValueError(f"{key}: {what} can be {_LARGEST:g} at most")

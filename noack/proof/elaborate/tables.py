"""Reading what a witness's document has: numbers, matrices and tables. All else is rejected."""

from collections.abc import Mapping, Sequence

from flint import arb, arb_mat

from noack.core.balls import number
from noack.proof.elaborate.errors import RejectedError

_MOST_ENTRIES = 100_000
"""Of a matrix. They are counted first: to read a number takes a microsecond."""


def read_table(table: Mapping[str, object], key: str) -> Mapping[str, object]:
    """Return a table within a table."""
    value = table.get(key)
    if not isinstance(value, Mapping):
        raise RejectedError(f"{key}: not a table")
    return value


def read_count(table: Mapping[str, object], key: str, most: int) -> int:
    """Return a whole number from 0 to ``most``; 0 if there is none."""
    value = table.get(key, 0)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
        raise RejectedError(f"{key}: not a whole number from 0 to {most}")
    return value


def read_number(table: Mapping[str, object], key: str) -> arb:
    """Return a finite number."""
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RejectedError(f"{key}: not a number")
    if isinstance(value, int) and abs(value) > 2**63:
        raise RejectedError(f"{key}: too large")
    found = number(value)
    if not found.is_finite():
        raise RejectedError(f"{key}: not finite")
    return found


def read_rows(table: Mapping[str, object], key: str) -> arb_mat:
    """Return a matrix of any size."""
    rows = table.get(key)
    if not isinstance(rows, list) or not rows or not all(isinstance(row, Sequence) for row in rows):
        raise RejectedError(f"{key}: not a matrix")
    if any(len(row) != len(rows[0]) for row in rows):
        raise RejectedError(f"{key}: rows of different lengths")
    if len(rows) * len(rows[0]) > _MOST_ENTRIES:
        raise RejectedError(f"{key}: more than {_MOST_ENTRIES:,} numbers")
    return arb_mat([[read_number({key: value}, key) for value in row] for row in rows])


def read_matrix(
    table: Mapping[str, object], key: str, size: int | None = None, *, most: int | None = None
) -> arb_mat:
    """Return a symmetric matrix, perhaps of a given size, or of at most some size."""
    found = read_rows(table, key)
    n = found.nrows()
    if found.ncols() != n or (size is not None and n != size) or (most is not None and n > most):
        raise RejectedError(f"{key}: not a square matrix of the right size")
    if any(found[i, j] != found[j, i] for i in range(n) for j in range(i)):
        raise RejectedError(f"{key}: not symmetric")
    return found

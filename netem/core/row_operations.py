"""Fast operations on the rows of tables: k vectors, (k, n), with many k and few n.

numpy's own operations along short rows take ten times as long.
"""

from functools import reduce

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

_SMALLEST_SAFE = 1e-140
"""Squares of vectors between this size and its inverse neither underflow nor overflow."""
_MOST_IN_TURN = 8
"""numpy, too, adds fewer terms one after the other, but takes ten times as long for many short rows."""


def row_norms(rows: Reals) -> Reals:
    """Return the Euclidean norms of k vectors, (k, n) → (k,), without overflow of squares.

    If the squares are safe, the results equal numpy's bit-exactly.
    """
    with np.errstate(over="ignore", under="ignore"):  # affected norms are recomputed below
        if 0 < rows.shape[1] < _MOST_IN_TURN:
            norms = np.asarray(np.sqrt(reduce(np.add, (entries * entries for entries in rows.T))))
        else:
            norms = np.asarray(np.linalg.norm(rows, axis=1))
    doubtful = (norms < _SMALLEST_SAFE) | ~(norms < 1 / _SMALLEST_SAFE)
    if doubtful.any():
        sizes = np.abs(rows[doubtful]).max(axis=1, initial=0.0)
        scales = np.where((sizes > 0) & np.isfinite(sizes), sizes, 1.0)
        norms[doubtful] = scales * np.linalg.norm(rows[doubtful] / scales[:, None], axis=1)
    return norms


def all_entries(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where something holds for every entry of a row, (k, n) → (k,).

    numpy's ``all`` takes ten times as long for many short rows, as do ``any`` and ``max``.
    """
    return np.asarray(reduce(np.logical_and, holds.T))


def set_rows(matrix: Reals, places: NDArray[np.intp], rows: Reals) -> None:
    """Set the rows of a matrix at k places to others, (k, n), entry by entry.

    ``matrix[places] = rows`` takes ten times as long for many short rows. Neither should rows be
    read so: ``matrix.take(places, axis=0)`` and ``matrix.compress(holds, axis=0)`` are fast.
    """
    for column, entries in zip(matrix.T, rows.T, strict=True):
        column[places] = entries


def largest_sizes(rows: Reals) -> Reals:
    """Return the size of the largest entry of each row, (k, n) → (k,); NaN if there is a NaN."""
    return np.asarray(reduce(np.maximum, np.abs(rows).T))


def firsts_of_equal(values: NDArray[np.generic]) -> NDArray[np.intp]:
    """Return the places where consecutive equal values begin, ascending.

    Comparing neighbours takes a fifth of the time of ``np.diff`` with a value before the first.
    """
    begins = np.ones(len(values), np.bool_)
    np.not_equal(values[1:], values[:-1], out=begins[1:])
    return np.flatnonzero(begins)

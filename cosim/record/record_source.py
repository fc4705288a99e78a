"""Where the rows of a record come from: memory, files, or another record, batch by batch."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.void]
Slice = Mapping[str, Rows]
"""Consecutive rows of several tables, up to the same time."""

BATCH_ROWS = 16_384
"""Largest number of rows of a table that are read at a time."""


def joined(parts: Sequence[Rows], dtype: np.dtype[np.void]) -> Rows:
    """Return rows of one type in one array, as raw bytes: numpy would join column by column."""
    if len(parts) == 1:
        return parts[0]
    if any(rows.dtype != dtype for rows in parts):
        return np.concatenate([np.zeros(0, dtype), *parts])
    raw = np.dtype((np.void, dtype.itemsize))
    found = np.concatenate([np.zeros(0, raw), *(rows.view(raw) for rows in parts)])
    return found.view(dtype)


def packed(rows: Rows, dtype: np.dtype[np.void]) -> Rows:
    """Return the columns of a type, without gaps between them."""
    if rows.dtype == dtype:
        return rows
    found = np.empty(len(rows), dtype)
    for name in dtype.names or ():
        found[name] = rows[name]
    return found


class RecordSource(ABC):
    """The tables of a record, with their row types."""

    def __init__(self, types: Mapping[str, np.dtype[np.void]]) -> None:
        self.types = types

    @abstractmethod
    def whole(self, table: str) -> Rows:
        """Return all rows of a table."""

    @abstractmethod
    def count(self, table: str) -> int:
        """Return the number of rows of a table."""

    def highest_input(self, table: str) -> int:
        """Return the highest number of an input in a table, or a higher one; −1 without rows."""
        highest = (rows["input"].max(initial=-1) for rows in self.batches(table, ("input",)))
        return int(max(highest, default=-1))

    @abstractmethod
    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Yield the rows of a table in order, with all columns or only some."""


class RowsInMemory(RecordSource):
    """Tables that are in memory."""

    def __init__(self, rows: Mapping[str, Rows]) -> None:
        super().__init__({table: found.dtype for table, found in rows.items()})
        self._rows = rows

    def whole(self, table: str) -> Rows:
        """Return all rows of a table."""
        return self._rows[table]

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        return len(self._rows[table])

    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Yield the rows of a table in order."""
        rows = self._rows[table]
        if columns:
            rows = rows[[name for name in rows.dtype.names or () if name in columns]]
        for first in range(0, len(rows), BATCH_ROWS):
            yield rows[first : first + BATCH_ROWS]


class DerivedRows(RecordSource):
    """The rows of another source, each batch changed or filtered by ``derive(table, rows)``."""

    def __init__(self, source: RecordSource, derive: Callable[[str, Rows], Rows]) -> None:
        super().__init__(source.types)
        self._source = source
        self._derive = derive

    def whole(self, table: str) -> Rows:
        """Return all rows of a table."""
        return self._derive(table, self._source.whole(table))

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        return sum(map(len, self.batches(table)))

    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Yield the rows of a table in order."""
        for rows in self._source.batches(table):
            yield self._derive(table, rows)


def with_columns(dtype: np.dtype[np.void], columns: Sequence[str]) -> np.dtype[np.void]:
    """Return a row type with only some columns; all of them if none are given."""
    if not columns:
        return dtype
    return np.dtype([(name, dtype[name]) for name in dtype.names or () if name in columns])


def slices(
    source: RecordSource, tables: Sequence[str], width_ns: int, columns: Sequence[str] = ()
) -> Iterator[Slice]:
    """Yield consecutive parts of some tables, with all columns or only some.

    A part contains the rows of each table up to the first row whose actual time ``now_ns`` is not
    before the part's end. The ends are multiples of ``width_ns``; intervals without rows are
    omitted.
    """
    if all(source.count(table) <= BATCH_ROWS for table in tables):
        parts = {table: [*source.batches(table, columns)] for table in tables}
        if any(parts.values()):
            yield {
                table: joined(found, with_columns(source.types[table], columns))
                for table, found in parts.items()
            }
        return
    readers = {table: _TableReader(source, table, columns) for table in tables}
    end_ns: int | None = None
    while True:
        next_ns = [at for reader in readers.values() if (at := reader.next_ns()) is not None]
        if not next_ns:
            return
        after_ns = (min(next_ns) // width_ns + 1) * width_ns
        end_ns = after_ns if end_ns is None else max(end_ns + width_ns, after_ns)
        yield {table: reader.until(end_ns) for table, reader in readers.items()}


class _TableReader:
    """Reads the rows of one table up to given times."""

    def __init__(self, source: RecordSource, table: str, columns: Sequence[str]) -> None:
        self._batches = source.batches(table, columns)
        self._rows: Rows = np.zeros(0, with_columns(source.types[table], columns))

    def next_ns(self) -> int | None:
        """Return the time of the next row; None if there is none."""
        while not len(self._rows):
            batch = next(self._batches, None)
            if batch is None:
                return None
            self._rows = batch
        return int(self._rows["now_ns"][0])

    def until(self, end_ns: int) -> Rows:
        """Return the next rows, up to the first one that is not before ``end_ns``."""
        found: list[Rows] = []
        while self.next_ns() is not None:
            later = self._rows["now_ns"] >= end_ns
            count = int(np.argmax(later)) if later.any() else len(later)
            found.append(self._rows[:count])
            self._rows = self._rows[count:]
            if len(self._rows):
                break
        if not found:
            return self._rows[:0]
        return joined(found, found[0].dtype)

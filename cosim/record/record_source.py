"""Where the rows of a record come from: memory, files, or another record, batch by batch.

The rows of plant, sensor and controller have the number of their loop. Those of the network are of
all loops. As rows of a loop (:class:`LoopTables`), they have the loop's own time, which is 0 at its
phase; its flows are numbered as if the loop were alone; and its inputs are numbered in turn
(:class:`NetworkRows`). A row that is missing in the record leaves its number free in every loop.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from noack.config.resolution import has_loop, is_of_network, network_tables
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import CLOCK_TABLES, LOOP, NETEM_SETTING

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
        return len(self.whole(table))

    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Yield the rows of a table in order."""
        rows = self.whole(table)
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


if TYPE_CHECKING:
    from cosim.record.table_files import StoredTables

_TIMES = ("t_ns", "now_ns", "since_ns", "release_ns", "copy_ns")
_NEVER = ("release_ns", "copy_ns")
"""Columns in which −1 is no time."""


def with_loop(rows: Rows, number: int, dtype: np.dtype[np.void]) -> Rows:
    """Return rows of a loop as rows of a run, whose vectors may be longer: their rest is NaN."""
    if rows.dtype == dtype:
        return rows
    found = np.zeros(len(rows), dtype)
    for name in rows.dtype.names or ():
        kind = dtype[name]
        if kind == rows.dtype[name]:
            found[name] = rows[name]
        else:
            found[name] = np.nan
            found[name][:, : rows.dtype[name].shape[0]] = rows[name]
    if LOOP in (dtype.names or ()):
        found[LOOP] = number
    return found


def without_loop(rows: Rows, dtype: np.dtype[np.void]) -> Rows:
    """Return rows of a run, all of one loop, as rows of this loop, of a type."""
    if rows.dtype == dtype:
        return rows
    found = np.empty(len(rows), dtype)
    for name in dtype.names or ():
        size = dtype[name].shape
        found[name] = rows[name][:, : size[0]] if size else rows[name]
    return found


def rows_by_loop(
    table: str,
    rows: Rows,
    phases_ns: Sequence[int],
    types: Sequence[Mapping[str, np.dtype[np.void]]],
) -> Iterator[tuple[int, Rows]]:
    """Yield the number and the rows of each loop, from a part of a table of a live run.

    The inputs of the emulator keep their numbers. The table of a process's clock is of every loop.

    Args:
        table: the table.
        rows: its rows.
        phases_ns: when each loop begins.
        types: the row types of the tables of each loop.
    """
    if table in CLOCK_TABLES:
        yield from enumerate(_shifted(rows, phase_ns) for phase_ns in phases_ns)
        return
    shared, numbers = is_of_network(table), np.zeros(len(rows), np.int64)
    has_flow = shared and "flow" in (rows.dtype.names or ())
    if has_flow:
        numbers = rows["flow"] % len(phases_ns)
    elif has_loop(table):
        numbers = rows[LOOP].astype(np.int64)
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers, minlength=len(phases_ns)))
    for number in np.unique(numbers).tolist():
        if number >= len(phases_ns):  # damaged
            continue
        chosen = rows.take(order[ends[number - 1] if number else 0 : ends[number]])
        if shared:
            _shift(chosen, phases_ns[number])
            if has_flow:
                chosen["flow"] //= len(phases_ns)
        yield number, without_loop(chosen, types[number][table])


class NetworkRows:
    """The rows of each loop in the tables of the network.

    Args:
        rows: all rows of the tables of the network.
        phases_ns: when each loop begins.
    """

    def __init__(self, rows: Mapping[str, Rows], phases_ns: Sequence[int]) -> None:
        self._rows = {table: rows[table] for table in network_tables()}
        self._phases_ns = phases_ns
        loops = {
            table: found["flow"] % len(phases_ns)
            for table, found in self._rows.items()
            if table != NETEM_SETTING  # a change of settings concerns every loop
        }
        self._inputs = np.sort(np.concatenate([found["input"] for found in self._rows.values()]))
        self._ends = {
            table: np.append(0, np.cumsum(np.bincount(loop[loop >= 0], minlength=len(phases_ns))))
            for table, loop in loops.items()
        }
        self._orders = {table: np.argsort(loop, kind="stable") for table, loop in loops.items()}
        self._counts: dict[tuple[str, int], int] = {}

    def counts(self) -> dict[str, NDArray[np.int64]]:
        """Return the number of rows of each loop by table, shape (loops,)."""
        loops = len(self._phases_ns)
        return {
            table: np.diff(self._ends[table]) if table in self._ends else np.full(loops, len(rows))
            for table, rows in self._rows.items()
        }

    def of_loop(self, number: int) -> dict[str, Rows]:
        """Return the rows of a loop."""
        own = {}
        for table, found in self._rows.items():
            chosen: Any = slice(None)
            if table in self._orders:
                first, last = self._ends[table][number : number + 2]
                chosen = self._orders[table][first:last]
            own[table] = found.take(chosen) if table in self._orders else found.copy()
        _renumber(own, self._inputs)
        for table, found in own.items():
            _shift(found, self._phases_ns[number])
            if table in self._orders:
                found["flow"] //= len(self._phases_ns)
        return own

    def count(self, table: str, generation: int) -> int:
        """Return the number of rows of a table and a generation of the emulator, of all loops."""
        key = table, generation
        if key not in self._counts:
            self._counts[key] = count_of(self._rows[table], generation)
        return self._counts[key]


def count_of(rows: Rows, generation: int) -> int:
    """Return the number of rows of a generation of their process."""
    return int((rows["input"] // GENERATION == generation).sum())


class LoopTables(RecordSource):
    """The tables of a loop in the record of a run; a table that is read as a whole is kept.

    Args:
        number: the number of the loop.
        types: the types of its rows.
        stored: the tables of the run.
        network: the loop's rows of the network.
        phase_ns: when the loop begins.
    """

    def __init__(
        self,
        number: int,
        types: Mapping[str, np.dtype[np.void]],
        stored: "StoredTables",
        network: RecordSource,
        phase_ns: int = 0,
    ) -> None:
        super().__init__(types)
        self._number, self._stored, self._network = number, stored, network
        self._phase_ns = phase_ns
        self._whole: dict[str, Rows] = {}
        self._counts: dict[str, int] = {}

    def whole(self, table: str) -> Rows:
        """Return all rows of a table."""
        if is_of_network(table):
            return self._network.whole(table)
        if table not in self._whole:
            self._whole[table] = joined([*self._read(table, ())], self.types[table])
        return self._whole[table]

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        if is_of_network(table):
            return self._network.count(table)
        if table not in self._counts:
            self._counts[table] = self._stored.count_of_loop(table, self._number)
        return self._counts[table]

    def highest_input(self, table: str) -> int:
        """Return the highest number of an input of any loop in a table; −1 without rows."""
        source = self._network if is_of_network(table) else self._stored
        return source.highest_input(table)

    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Yield the rows of a table in order; a short one is kept."""
        if is_of_network(table):
            yield from self._network.batches(table, columns)
        elif table in self._whole or self.count(table) <= BATCH_ROWS:
            self.whole(table)
            yield from RowsInMemory(self._whole).batches(table, columns)
        else:
            yield from self._read(table, columns)

    def _read(self, table: str, columns: Sequence[str]) -> Iterator[Rows]:
        of_loop = self._stored.of_loop
        for rows in of_loop(table, self._number, with_columns(self.types[table], columns)):
            yield _shifted(rows, self._phase_ns) if table in CLOCK_TABLES else rows


def _renumber(own: Mapping[str, Rows], inputs: NDArray[np.int64]) -> None:
    """Number a loop's inputs in turn, within each generation of the emulator.

    ``inputs`` has the numbers of all loops, ascending. The rows of other loops are left out of the
    count; rows that are missing are not.
    """
    mine = np.sort(np.concatenate([found["input"] for found in own.values()]))
    for found in own.values():
        numbers = found["input"].copy()
        begin = numbers // GENERATION * GENERATION
        for counted, sign in ((inputs, -1), (mine, 1)):
            before = np.searchsorted(counted, numbers) - np.searchsorted(counted, begin)
            found["input"] += sign * before


def _shifted(rows: Rows, phase_ns: int) -> Rows:
    """Return rows with times of a loop in place of those of the run."""
    if not phase_ns:
        return rows
    rows = rows.copy()
    _shift(rows, phase_ns)
    return rows


def _shift(rows: Rows, phase_ns: int) -> None:
    """Change times of the run into times of a loop."""
    for name in _TIMES:
        if name in (rows.dtype.names or ()):
            is_time = rows[name] >= 0 if name in _NEVER else slice(None)
            rows[name][is_time] -= phase_ns
            if "since_ns" in (rows.dtype.names or ()) and name != "now_ns":
                np.maximum(rows[name], 0, out=rows[name])  # a change before the loop begins

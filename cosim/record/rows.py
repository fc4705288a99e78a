"""Rows of a record: parts of tables as structured arrays, and which loop they are of.

A structured array has the bytes that the machines write, so that a replay can compare them; its
columns are ``rows["x"]``, as those of a dictionary of arrays.

The rows of plant, sensor and controller have the number of their loop. Those of the network are of
all loops. As rows of a loop, they have the loop's own time, which is 0 at its phase; its flows are
numbered as if the loop were alone; and its inputs are numbered in turn (:class:`NetworkRows`). A row
that is missing in the record leaves its number free in every loop.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.row_operations import firsts_of_equal
from noack.protocol.record_tables import LOOP, NETEM_SETTING, is_of_network, network_tables
from noack.protocol.wire_format import HEADER_ROW, MAGIC, VERSIONS, Flow

Rows = NDArray[np.void]
Slice = Mapping[str, Rows]
"""Consecutive rows of several tables, up to the same time."""
ReadRows = Callable[[str, Sequence[str]], Iterator[Rows]]
"""``read(table, columns)`` yields the rows of a table in order, part by part, with all columns or, if
some are given, at least with these."""

BATCH_ROWS = 16_384
"""A table of at most this many rows is read whole; a longer one in parts of this size."""
_LOOKED_AT = 4096
"""Rows that are looked at together for the end of a part."""
_TIMES = ("t_ns", "now_ns", "since_ns", "release_ns", "copy_ns")
"""Columns with times, which are those of the run or of a loop."""
_MAY_BE_NEVER = ("release_ns", "copy_ns")
"""Those in which −1 is no time."""


class Segment(NamedTuple):
    """Rows of a table that can be read at once; the numbers of their inputs."""

    first: int
    last: int
    read: Callable[[], Rows]

    def of_loop(self, number: int) -> "Segment":
        """Return the rows of a loop."""

        def read() -> Rows:
            rows = self.read()
            return rows.compress(rows[LOOP] == number)

        return self._replace(read=read)


def concatenate_rows(parts: Sequence[Rows], dtype: np.dtype[np.void]) -> Rows:
    """Return rows of one type in one array, as raw bytes: numpy would join column by column."""
    if len(parts) == 1:
        return parts[0]
    if any(rows.dtype != dtype for rows in parts):
        return np.concatenate([np.zeros(0, dtype), *parts])
    raw = np.dtype((np.void, dtype.itemsize))
    content = np.concatenate([np.zeros(0, raw), *(rows.view(raw) for rows in parts)])
    return content.view(dtype)


def parts_by_loop(rows: Rows, numbers: NDArray[np.integer]) -> Iterator[tuple[int, Rows]]:
    """Yield consecutive rows of the same loop, with its number, from the number of each row."""
    begins = firsts_of_equal(numbers).tolist()
    for begin, end in pairwise([*begins, len(rows)]):
        yield int(numbers[begin]), rows[begin:end]


def with_columns(dtype: np.dtype[np.void], columns: Sequence[str]) -> np.dtype[np.void]:
    """Return a row type with only some columns; all of them if none are given."""
    if not columns:
        return dtype
    return np.dtype([(name, dtype[name]) for name in dtype.names or () if name in columns])


def slices(readers: Mapping[str, Iterator[Rows]], empty: Slice, width_ns: int) -> Iterator[Slice]:
    """Yield consecutive parts of some tables.

    A part contains the rows of each table up to the first row whose actual time ``now_ns`` is not
    before the part's end. The ends are multiples of ``width_ns``; intervals without rows are
    omitted.

    Args:
        readers: the rows of each table, in order.
        empty: no row of each table.
        width_ns: the duration of a part.
    """
    waiting = dict(empty)
    end_ns: int | None = None
    while True:
        for table, reader in readers.items():
            while not len(waiting[table]) and (rows := next(reader, None)) is not None:
                waiting[table] = rows
        next_ns = [int(rows["now_ns"][0]) for rows in waiting.values() if len(rows)]
        if not next_ns:
            return
        after_ns = (min(next_ns) // width_ns + 1) * width_ns
        end_ns = after_ns if end_ns is None else max(end_ns + width_ns, after_ns)
        part = {}
        for table, reader in readers.items():
            part[table], waiting[table] = _split_at(end_ns, waiting[table], reader)
        yield part


def _split_at(end_ns: int, rows: Rows, reader: Iterator[Rows]) -> tuple[Rows, Rows]:
    """Return the next rows up to the first one that is not before ``end_ns``, and those after them."""
    parts: list[Rows] = []
    while True:
        count = _count_before(end_ns, rows["now_ns"])
        if count:  # a part of its own need not be copied
            parts.append(rows[:count])
        rows = rows[count:]
        if len(rows) or (batch := next(reader, None)) is None:
            return concatenate_rows(parts or [rows[:0]], rows.dtype), rows
        rows = batch


def _count_before(end_ns: int, times_ns: NDArray[np.int64]) -> int:
    """Return the number of times up to the first one that is not before ``end_ns``.

    Little more than those is looked at: a record in memory has all rows of a table in one array.
    """
    for begin in range(0, len(times_ns), _LOOKED_AT):
        later = times_ns[begin : begin + _LOOKED_AT] >= end_ns
        if later.any():
            return begin + int(np.argmax(later))
    return len(times_ns)


def with_loop(rows: Rows, number: int, dtype: np.dtype[np.void]) -> Rows:
    """Return rows of a loop as rows of a run, whose vectors may be longer: their rest is NaN."""
    if rows.dtype == dtype:
        return rows
    converted = np.zeros(len(rows), dtype)
    for name in rows.dtype.names or ():
        kind = dtype[name]
        if kind == rows.dtype[name]:
            converted[name] = rows[name]
        else:
            converted[name] = np.nan
            converted[name][:, : rows.dtype[name].shape[0]] = rows[name]
    if LOOP in (dtype.names or ()):
        converted[LOOP] = number
    return converted


def pack_rows(rows: Rows, dtype: np.dtype[np.void]) -> Rows:
    """Return the columns of a type without gaps, of a vector the first entries."""
    if rows.dtype == dtype:
        return rows
    converted = np.empty(len(rows), dtype)
    for name in dtype.names or ():
        size = dtype[name].shape
        converted[name] = rows[name][:, : size[0]] if size else rows[name]
    return converted


def rows_by_loop(
    table: str,
    rows: Rows,
    phases_ns: Sequence[int],
    types: Sequence[Mapping[str, np.dtype[np.void]]],
) -> Iterator[tuple[int, Rows]]:
    """Yield the number and the rows of each loop, from a part of a table of a live run.

    The inputs of the emulator keep their numbers.

    Args:
        table: the table.
        rows: its rows.
        phases_ns: when each loop begins.
        types: the row types of the tables of each loop.
    """
    numbers = np.zeros(len(rows), np.int64)
    if "flow" in (rows.dtype.names or ()):
        numbers = rows["flow"] % len(phases_ns)
    else:
        numbers = rows[LOOP].astype(np.int64)
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers, minlength=len(phases_ns)))
    for number in np.unique(numbers).tolist():
        if number >= len(phases_ns):  # damaged
            continue
        rows_of_loop = rows.take(order[ends[number - 1] if number else 0 : ends[number]])
        if is_of_network(table):
            rows_of_loop = _of_loop(rows_of_loop, number, phases_ns)
        yield number, pack_rows(rows_of_loop, types[number][table])


class NetworkRows:
    """The rows of each loop in the tables of the network.

    Args:
        read: reads the rows of all loops.
        phases_ns: when each loop begins.
    """

    def __init__(self, read: ReadRows, phases_ns: Sequence[int]) -> None:
        self._read, self._phases_ns = read, phases_ns
        self._inputs: dict[str, NDArray[np.int64]] = {}
        self._indices: dict[str, list[NDArray[np.int32]]] = {}
        """The indices of the rows of each loop in a table."""
        for table in network_tables():
            batches = [*read(table, ("input", "flow"))]
            inputs = [rows["input"] for rows in batches]
            self._inputs[table] = np.concatenate([np.zeros(0, np.int64), *inputs])
            if table == NETEM_SETTING:  # a change of settings concerns every loop
                everywhere = np.arange(len(self._inputs[table]), dtype=np.int32)
                self._indices[table] = [everywhere] * len(phases_ns)
                continue
            flows = [rows["flow"] for rows in batches]
            loops = np.concatenate([np.zeros(0, np.int64), *flows]) % len(phases_ns)
            ends = np.cumsum(np.bincount(loops, minlength=len(phases_ns)))
            order = np.argsort(loops, kind="stable").astype(np.int32)
            self._indices[table] = np.split(order, ends[:-1])
        self._in_order = np.sort(np.concatenate([*self._inputs.values()]))

    def counts(self) -> dict[str, NDArray[np.int64]]:
        """Return the number of rows of each loop by table, shape (loops,)."""
        return {table: np.array(list(map(len, indices))) for table, indices in self._indices.items()}

    def of_loop(self, table: str, number: int) -> Iterator[Rows]:
        """Yield the rows of a loop in order."""
        return (rows for (rows,) in self.of_loops(table, [number]))

    def of_loops(self, table: str, numbers: Sequence[int]) -> Iterator[list[Rows]]:
        """Yield the next rows of each of some loops, in order; the table is read once."""
        by_number = [[indices[number] for indices in self._indices.values()] for number in numbers]
        parts = [[*map(np.take, self._inputs.values(), indices)] for indices in by_number]
        inputs_of_loops = [np.sort(np.concatenate(inputs)) for inputs in parts]
        first = 0
        for rows in self._read(table, ()):
            by_loop = []
            for number, inputs in zip(numbers, inputs_of_loops, strict=True):
                indices = self._indices[table][number]
                begin, end = np.searchsorted(indices, (first, first + len(rows)))
                rows_of_loop = rows.take(indices[begin:end] - first)
                rows_of_loop["input"] -= self._numbered_before(rows_of_loop["input"], inputs)
                by_loop.append(_of_loop(rows_of_loop, number, self._phases_ns))
            yield by_loop
            first += len(rows)

    def _numbered_before(
        self, numbers: NDArray[np.int64], own_inputs: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return how many inputs of other loops precede those of a loop.

        ``own_inputs`` has all numbers of the loop, ascending. Rows that are missing count as the loop's.
        """
        return np.asarray(np.searchsorted(self._in_order, numbers) - np.searchsorted(own_inputs, numbers))

    def count_of_others(self, number: int, table: str) -> int:
        """Return how many rows of a table are of other loops than a loop."""
        return len(self._inputs[table]) - len(self._indices[table][number])


def _of_loop(rows: Rows, number: int, phases_ns: Sequence[int]) -> Rows:
    """Change rows of the network, all of one loop, into those of this loop."""
    _shift(rows, phases_ns[number])
    if "flow" in (rows.dtype.names or ()):
        rows["flow"] //= len(phases_ns)
    return rows


def _shift(rows: Rows, phase_ns: int) -> None:
    """Change times of the run into times of a loop."""
    for name in _TIMES:
        if name in (rows.dtype.names or ()):
            is_time = rows[name] >= 0 if name in _MAY_BE_NEVER else slice(None)
            rows[name][is_time] -= phase_ns
            if "since_ns" in (rows.dtype.names or ()) and name != "now_ns":
                np.maximum(rows[name], 0, out=rows[name])  # a change before the loop begins


def messages_in(packets: Rows, flow: Flow = Flow.UPDATE) -> tuple[Rows, NDArray[np.int64], NDArray[np.int64]]:
    """Select the loop's messages of a flow from the packets that reached the network emulator.

    The emulator reads no payload, so the packets' headers are read here.

    Returns:
        Their rows of ``netem_packet``, sequence numbers and event times.
    """
    headers = np.ascontiguousarray(packets["head"]).view(HEADER_ROW)
    is_of_flow = np.logical_or.reduce([headers["version"] == version for version in VERSIONS])
    is_of_flow &= (headers["magic"] == MAGIC) & (headers["flow"] == flow) & (headers["t_ns"] >= 0)
    is_of_flow &= headers["sequence"] < 2**63  # others do not fit the record's columns
    return (
        packets.compress(is_of_flow),
        headers["sequence"].compress(is_of_flow).astype(np.int64),
        headers["t_ns"].compress(is_of_flow),
    )

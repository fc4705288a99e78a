"""The files of a record: one Parquet file per table, written and read batch by batch.

Vectors are stored as one column per entry (``x_1``, ``x_2``, …), so every Parquet reader can read
them.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.record.record_source import (
    BATCH_ROWS,
    RecordSource,
    Rows,
    RowsInMemory,
    joined,
    with_columns,
    without_loop,
)
from cosim.record.spool_conversion import Segment
from noack.core.cached_method import cached_method
from noack.core.errors import CallerError, one_line
from noack.core.file_access import new_file
from noack.protocol.record_tables import LOOP, OWNER, entry_names
from noack.protocol.wire_format import MAX_LOOPS

_GROUP_ROWS = 2 * BATCH_ROWS
_LEAST_GROUP_ROWS = 4096
_ENCODINGS = {
    pa.int64(): "DELTA_BINARY_PACKED",
    pa.uint16(): "DELTA_BINARY_PACKED",
    pa.float64(): "BYTE_STREAM_SPLIT",
}
"""Of numbers that follow each other in equal steps, and of numbers of similar size."""
RowType = np.dtype[np.void]


class StoredTables(RecordSource):
    """The tables of a record in its folder; a table that is read as a whole is kept.

    Args:
        folder: the folder.
        types: the types of the tables' rows.
        most_rows: number of rows that a table can have; a file of a few kilobytes may claim more
            than fit into memory.

    Raises:
        CallerError: a file cannot be read, has too many rows, or does not have all columns of its
            type.
    """

    def __init__(self, folder: Path, types: Mapping[str, RowType], most_rows: int) -> None:
        super().__init__(types)
        self._folder, self._most_rows = folder, most_rows
        self._whole: dict[str, Rows] = {}
        self._groups: dict[str, list[_Group]] = {}
        self._newest: dict[str, tuple[int, Rows]] = {}
        """The group of several loops that was read last, by table."""
        self._counts = {table: self._check(table) for table in types}

    def whole(self, table: str) -> Rows:
        """Read all rows of a table."""
        if table not in self._whole:
            dtype = self.types[table]
            self._whole[table] = joined([*read_batches(self.path(table), dtype)], dtype)
        return self._whole[table]

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        return self._counts[table]

    def batches(self, table: str, columns: Sequence[str] = ()) -> Iterator[Rows]:
        """Read the rows of a table in order; a short one is kept."""
        if table in self._whole or self._counts[table] <= BATCH_ROWS:
            self.whole(table)
            yield from RowsInMemory(self._whole).batches(table, columns)
        else:
            yield from read_batches(self.path(table), with_columns(self.types[table], columns))

    def of_loop(self, table: str, number: int, dtype: RowType) -> Iterator[Rows]:
        """Read the rows of a loop in order, as rows of a type; of a table without loops, all."""
        if LOOP not in (self.types[table].names or ()):
            yield from self.batches(table, dtype.names or ())
            return
        for place, group in enumerate(self._groups[table]):
            if group.first == number == group.last:
                yield from _read_batches(self.path(table), [place], dtype)
            elif group.first <= number <= group.last:
                rows = self._mixed(table, place)
                yield without_loop(rows.compress(rows[LOOP] == number), dtype)

    def count_of_loop(self, table: str, number: int) -> int:
        """Return the number of rows of a loop; of a table without loops, of all rows."""
        if LOOP not in (self.types[table].names or ()):
            return self.count(table)
        return sum(
            group.rows
            if group.first == number == group.last
            else int((self._mixed(table, place)[LOOP] == number).sum())
            for place, group in enumerate(self._groups[table])
            if group.first <= number <= group.last
        )

    def _mixed(self, table: str, place: int) -> Rows:
        """Read a group with rows of several loops; the loops are usually read in turn."""
        newest, rows = self._newest.get(table, (-1, None))
        if newest != place or rows is None:
            rows = _read_group(self.path(table), place, self.types[table])
            self._newest[table] = place, rows
        return rows

    @cached_method
    def highest_input(self, table: str) -> int:
        """Return the highest number of an input in a table; −1 without rows."""
        groups = self._groups[table]
        if any(group.highest_input is None for group in groups):
            return super().highest_input(table)
        return max((group.highest_input or 0 for group in groups), default=-1)

    def path(self, table: str) -> Path:
        """Return the file of a table."""
        return self._folder / f"{table}.parquet"

    def _check(self, table: str) -> int:
        """Check the schema of a file; return its number of rows."""
        path = self.path(table)
        with _readable(path), pq.ParquetFile(path) as file:
            schema, metadata = file.schema_arrow, file.metadata
            if metadata.num_rows > self._most_rows:
                raise CallerError(
                    f"{path}: has {metadata.num_rows:,} rows; a run of this scenario has at most "
                    f"{self._most_rows:,}"
                )
            _require_parts(path, metadata)
            _require_columns(path, schema, self.types[table])
            groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
            self._groups[table] = [_group(one, metadata) for one in groups]
            for column, _ in _columns(self.types[table]):
                place = metadata.schema.names.index(column)
                found = [group.column(place).statistics for group in groups]
                if any(one is not None and one.null_count for one in found):
                    raise CallerError(f"{path}: column {column} has holes")
            return int(metadata.num_rows)


class _Group(NamedTuple):
    """A row group of a file."""

    rows: int
    first: int
    """Lowest number of a loop."""
    last: int
    """Highest number of a loop."""
    highest_input: int | None
    """Highest number of an input; None if unknown."""


def _group(group: Any, metadata: pq.FileMetaData) -> _Group:
    names = metadata.schema.names
    loops, inputs = (
        group.column(names.index(name)).statistics if name in names else None
        for name in (LOOP, "input")
    )
    highest = int(inputs.max) if inputs is not None and inputs.has_min_max else None
    if loops is None or not loops.has_min_max:
        return _Group(group.num_rows, 0, MAX_LOOPS, highest)
    return _Group(group.num_rows, int(loops.min), int(loops.max), highest)


def read_table(path: Path, dtype: RowType) -> pa.Table:
    """Read a table's file as it is.

    Raises:
        CallerError: the file cannot be read, or does not have all columns of that type.
    """
    with _readable(path):
        table = pq.read_table(path)
        table.validate(full=True)
        _require_columns(path, table.schema, dtype)
    for column, _ in _columns(dtype):
        _require_whole(path, column, table.column(column))
    return table


def read_batches(path: Path, dtype: RowType) -> Iterator[Rows]:
    """Yield the rows of a table's file, ``BATCH_ROWS`` at a time.

    Raises:
        CallerError: as :func:`read_table`.
    """
    yield from _read_batches(path, None, dtype)


def _read_batches(path: Path, groups: Sequence[int] | None, dtype: RowType) -> Iterator[Rows]:
    """Yield the rows of some groups of a file, by default of all."""
    names = [column for column, _ in _columns(dtype)]
    with _readable(path), pq.ParquetFile(path) as file:
        _require_columns(path, file.schema_arrow, dtype)
        for group in range(file.num_row_groups) if groups is None else groups:
            # A reader of several groups would keep the memory of all of them to the end.
            for batch in file.iter_batches(
                BATCH_ROWS, row_groups=[group], columns=names, use_threads=False
            ):
                batch.validate(full=True)
                yield _rows(path, batch, dtype)


def group_segments(path: Path, dtype: RowType) -> Iterator[Segment]:
    """Yield the row groups of a table's file as segments.

    Raises:
        CallerError: as :func:`read_table`.
    """
    with _readable(path), pq.ParquetFile(path) as file:
        _require_parts(path, file.metadata)
        groups = file.num_row_groups
    for group in range(groups):
        inputs = _read_group(path, group, with_columns(dtype, ("input",)))["input"]
        if len(inputs):
            read = partial(_read_group, path, group, dtype)
            yield Segment(int(inputs.min()), int(inputs.max()), read)


def _require_parts(path: Path, metadata: pq.FileMetaData) -> None:
    """Raise CallerError if a part of a file has more rows than noack writes into one."""
    rows = max((metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)), default=0)
    if rows > _GROUP_ROWS:
        raise CallerError(f"{path}: has {rows:,} rows in one part; noack writes {_GROUP_ROWS:,}")


def _read_group(path: Path, group: int, dtype: RowType) -> Rows:
    names = [column for column, _ in _columns(dtype)]
    with _readable(path), pq.ParquetFile(path) as file:
        _require_columns(path, file.schema_arrow, dtype)
        table = file.read_row_group(group, columns=names).combine_chunks()
        table.validate(full=True)
        batches = table.to_batches()
        return joined([_rows(path, one, dtype) for one in batches], dtype)


def write_table(
    path: Path, batches: Iterable[Rows], dtype: RowType, names: Mapping[str, Sequence[str]]
) -> None:
    """Write a table's file from batches of rows, those of each loop in turn.

    ``names`` are those of states and inputs, if they are the same in all loops.

    Raises:
        OSError: the file cannot be written.
    """
    metadata = {"noack_table": path.stem, "process": OWNER[path.stem]}
    metadata |= {key: json.dumps(value) for key, value in names.items()}
    schema = pa.schema(list(_columns(dtype))).with_metadata(metadata)
    # A dictionary, the default, takes twice the time and the space.
    options: dict[str, Any] = {"compression": "zstd", "use_dictionary": False}
    encodings = {name: _ENCODINGS[kind] for name, kind in _columns(dtype) if kind in _ENCODINGS}
    with (
        new_file(path, make_folder=False) as file,
        pq.ParquetWriter(file, schema, column_encoding=encodings, **options) as writer,
    ):
        for rows in _regrouped(batches, dtype):
            writer.write_table(pa.table(_arrays(rows), schema=schema))


def arrow_table(rows: Rows) -> pa.Table:
    """Return rows as a table with a column for each entry of a vector."""
    return pa.table(_arrays(rows))


def _regrouped(batches: Iterable[Rows], dtype: RowType) -> Iterator[Rows]:
    """Yield the same rows in batches of at most ``_GROUP_ROWS``.

    A loop with enough rows begins a batch of its own; so it can be read alone.
    """
    waiting: list[Rows] = []
    count = 0
    for batch in batches:
        if not len(batch):  # a loop without rows
            continue
        begins = count and LOOP in (dtype.names or ()) and waiting[-1][LOOP][-1] != batch[LOOP][0]
        if count >= _LEAST_GROUP_ROWS and begins:
            yield joined(waiting, dtype)
            waiting, count = [], 0
        waiting.append(batch)
        count += len(batch)
        if count >= _GROUP_ROWS:
            rows = joined(waiting, dtype)
            whole = count - count % _GROUP_ROWS
            for first in range(0, whole, _GROUP_ROWS):
                yield rows[first : first + _GROUP_ROWS]
            waiting, count = [rows[whole:].copy()], count - whole
    if count:
        yield joined(waiting, dtype)


def _arrays(rows: Rows) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.ndim == 2:
            for entry, values in zip(entry_names(name, column.shape[1]), column.T, strict=True):
                columns[entry] = _array(values)
        else:
            columns[name] = _array(column)
    return columns


def _array(values: NDArray[Any]) -> Any:
    """Return numbers or bytes as an Arrow array; ``pa.array`` would import pandas."""
    kind, width = values.dtype, values.dtype.itemsize
    type_ = pa.binary(width) if kind.kind == "V" else pa.from_numpy_dtype(kind)
    data = pa.py_buffer(np.ascontiguousarray(values).data.cast("B"))
    return pa.Array.from_buffers(type_, len(values), [None, data])


def _rows(path: Path, batch: pa.RecordBatch, dtype: RowType) -> Rows:
    rows = np.zeros(batch.num_rows, dtype)
    for name in dtype.names or ():
        field = dtype[name]
        entries = entry_names(name, field.shape[0]) if field.shape else (name,)
        for i, entry in enumerate(entries):
            column = batch.column(entry)
            _require_whole(path, entry, column)
            if field.shape:
                rows[name][:, i] = _values(column, field.base)
            else:
                rows[name] = _values(column, field)
    return rows


def _values(column: Any, field: np.dtype[Any]) -> NDArray[Any]:
    """Return the values of an Arrow array; its ``to_numpy`` would import pandas."""
    if not len(column):
        return np.zeros(0, field)
    data: memoryview = memoryview(column.buffers()[1])
    return np.frombuffer(data, field, len(column), column.offset * field.itemsize)


def _columns(dtype: RowType) -> Iterator[tuple[str, pa.DataType]]:
    """Yield the names of a table's columns in its file, and their types."""
    for name in dtype.names or ():
        field = dtype[name]
        if field.shape:
            kind = pa.from_numpy_dtype(field.base)
            yield from ((entry, kind) for entry in entry_names(name, field.shape[0]))
        elif field.kind == "V":
            yield name, pa.binary(field.itemsize)
        else:
            yield name, pa.from_numpy_dtype(field)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    if path.exists() and not path.is_file():
        raise CallerError(f"{path}: not a regular file")  # a FIFO would block
    try:
        yield
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise CallerError(f"{path}: cannot be read: {one_line(error)}") from None


def _require_columns(path: Path, schema: pa.Schema, dtype: RowType) -> None:
    for column, kind in _columns(dtype):
        found = schema.get_all_field_indices(column)
        if not found and column == LOOP:
            raise CallerError(
                f"{path}: has no column {LOOP}: an earlier version of noack recorded this run, "
                "which this version does not read"
            )
        if not found:
            raise CallerError(f"{path}: has no column {column}, which this scenario's runs have")
        if len(found) > 1 or schema.field(found[0]).type != kind:
            raise CallerError(f"{path}: column {column} is not one of {kind}")


def _require_whole(path: Path, name: str, column: Any) -> None:
    if column.null_count:
        raise CallerError(f"{path}: column {name} has holes")

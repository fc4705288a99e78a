"""The files of a record: one Parquet file per table, written and read batch by batch.

Vectors are stored as one column per entry (``x_1``, ``x_2``, …), so every Parquet reader can read
them.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.record.rows import BATCH_ROWS, Rows, Segment, concatenate_rows, parts_by_loop, with_columns
from netem.core.errors import CallerError, one_line, why
from netem.core.file_access import new_file
from noack.protocol.record_tables import LOOP, OWNER, entry_names
from noack.protocol.wire_format import MAX_LOOPS

_LEAST_GROUP_ROWS = 3 * BATCH_ROWS // 4
_ROWS_IN_CACHE = 2048
"""Rows that stay in the processor's cache while they are filled column by column."""
MOST_ROWS = 2**62
"""More than any file has."""
_ENCODINGS = {
    pa.int64(): "DELTA_BINARY_PACKED",
    pa.uint16(): "DELTA_BINARY_PACKED",
    pa.float64(): "BYTE_STREAM_SPLIT",
}
"""Of numbers that follow each other in equal steps, and of numbers of similar size."""
RowType = np.dtype[np.void]


class _Group(NamedTuple):
    """A row group of a file."""

    rows: int
    first: int
    """Lowest number of a loop."""
    last: int
    """Highest number of a loop."""


class TableFile:
    """The file of a table, read group by group.

    Args:
        path: the file.
        dtype: the type of its rows; the file may have more columns.
        most_rows: number of rows that the table can have; a file of a few kilobytes may claim more
            than fit into memory.

    Raises:
        CallerError: the file cannot be read, has too many rows, also in one group, does not have
            all columns of its type, or has groups of other types. A column with missing values is
            refused when it is read.
    """

    def __init__(self, path: Path, dtype: RowType, most_rows: int = MOST_ROWS) -> None:
        self._path, self._dtype = path, dtype
        self._metadata: pq.FileMetaData | None = None
        """Kept, since that of a file with many groups takes milliseconds to read."""
        with self._open() as file:
            metadata = self._metadata = file.metadata
            groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
            self.rows = int(metadata.num_rows)
            if self.rows > most_rows:
                raise CallerError(
                    f"{path}: has {self.rows:,} rows; a run of this scenario has at most {most_rows:,}"
                )
            if (largest := max((group.num_rows for group in groups), default=0)) > BATCH_ROWS:
                raise CallerError(
                    f"{path}: has {largest:,} rows in one part; at most {BATCH_ROWS:,} are read"
                )
            names = metadata.schema.names
            loop_column = names.index(LOOP) if LOOP in names else None
            if loop_column is not None:
                _require_type(file, loop_column)
        self.groups = [_describe_group(group, loop_column) for group in groups]

    def batches(self, dtype: RowType | None = None, groups: Iterable[int] | None = None) -> Iterator[Rows]:
        """Yield the rows of each group, or of some, as rows of a type that has fewer columns."""
        with self._open() as file:
            for group in range(len(self.groups)) if groups is None else groups:
                table = self._read(file, group, dtype or self._dtype)
                yield self._rows(table, dtype or self._dtype)

    def of_loops(self, loops: range, dtype: RowType) -> Iterator[tuple[int, Rows]]:
        """Yield the rows of some loops in order, as rows of a type, in parts with their loop's number."""
        kind = self._dtype[LOOP]
        with self._open() as file:
            for group, (_, first, last) in enumerate(self.groups):
                if first < loops.stop and loops.start <= last:
                    table = self._read(file, group, dtype, LOOP)
                    numbers = _values(self._path, LOOP, table[LOOP], kind)
                    for number, rows in parts_by_loop(self._rows(table, dtype), numbers):
                        if number in loops:
                            yield number, rows

    def whole(self) -> pa.Table:
        """Return the table with all columns of the file."""
        with self._open() as file:
            table = file.read()
            table.validate(full=True)
        for column, _ in _columns(self._dtype):
            _require_no_nulls(self._path, column, table.column(column))
        return table

    def segments(self) -> Iterator[Segment]:
        """Yield the groups as segments."""
        for group, rows in enumerate(self.batches(with_columns(self._dtype, ("input",)))):
            if len(rows):
                read = partial(self._read_group, group)
                yield Segment(int(rows["input"].min()), int(rows["input"].max()), read)

    def _read_group(self, group: int) -> Rows:
        (rows,) = self.batches(groups=[group])
        return rows

    @contextmanager
    def _open(self) -> Iterator[pq.ParquetFile]:
        with (
            _readable(self._path),
            pq.ParquetFile(self._path, metadata=self._metadata, page_checksum_verification=True) as file,
        ):
            _require_columns(self._path, file.schema_arrow, self._dtype)
            yield file

    def _read(self, file: pq.ParquetFile, group: int, dtype: RowType, *more: str) -> pa.Table:
        names = [column for column, _ in _columns(dtype)]
        # One thread, whose memory is used again.
        table = file.read_row_group(group, columns=[*more, *names], use_threads=False).combine_chunks()
        table.validate(full=True)
        return table

    def _rows(self, table: pa.Table, dtype: RowType) -> Rows:
        rows, columns, copies = np.empty(len(table), dtype), _columns(dtype), []
        for name in dtype.names or ():
            field = dtype[name]
            for entry in rows[name].T if field.shape else [rows[name]]:
                column, _ = next(columns)
                copies.append((entry, _values(self._path, column, table[column], field.base)))
        for first in range(0, len(rows), _ROWS_IN_CACHE):
            for entry, values in copies:
                entry[first : first + _ROWS_IN_CACHE] = values[first : first + _ROWS_IN_CACHE]
        return rows


def _require_type(file: pq.ParquetFile, column: int) -> None:
    """Raise ArrowException if a group has another type of a column than the schema.

    The statistics of such a group would end the process: the library throws an error that pyarrow
    does not catch. It does catch that of reading, here of the first row.
    """
    for group in range(file.num_row_groups):
        next(
            file.reader.iter_batches(1, row_groups=[group], column_indices=[column], use_threads=False), None
        )


def _describe_group(group: Any, loop_column: int | None) -> _Group:
    loops = None if loop_column is None else group.column(loop_column).statistics
    if loops is None or not loops.has_min_max:
        return _Group(group.num_rows, 0, MAX_LOOPS)
    return _Group(group.num_rows, int(loops.min), int(loops.max))


@contextmanager
def table_writer(
    path: Path, dtype: RowType, names: Mapping[str, Sequence[str]]
) -> Iterator[Callable[[Rows], None]]:
    """Write a table's file group by group, with what is yielded; it appears at the end.

    ``names`` are those of states and inputs, if they are the same in all loops.

    Raises:
        OSError: the file cannot be written.
    """
    metadata = {"noack_table": path.stem, "process": OWNER[path.stem]}
    metadata |= {key: json.dumps(value) for key, value in names.items()}
    schema = pa.schema(list(_columns(dtype))).with_metadata(metadata)
    # A dictionary, the default, takes twice the time and the space; zstd saves 1 % more space than
    # lz4, and takes a third more time. Checksums take a tenth more, and show changed bytes.
    options: dict[str, Any] = {"compression": "lz4", "use_dictionary": False, "write_page_checksum": True}
    encodings = {name: _ENCODINGS[kind] for name, kind in _columns(dtype) if kind in _ENCODINGS}
    with (
        new_file(path, make_folder=False) as file,
        pq.ParquetWriter(file, schema, column_encoding=encodings, **options) as writer,
    ):
        yield lambda rows: writer.write_table(pa.table(_arrays(rows), schema=schema))


def write_table(
    path: Path, batches: Iterable[Rows], dtype: RowType, names: Mapping[str, Sequence[str]]
) -> None:
    """Write a table's file from batches of rows, those of each loop in turn.

    Raises:
        OSError: the file cannot be written.
    """
    with table_writer(path, dtype, names) as write:
        for rows in _regroup(batches, dtype):
            write(rows)


def arrow_table(rows: Rows) -> pa.Table:
    """Return rows as a table with a column for each entry of a vector."""
    return pa.table(_arrays(rows))


def _regroup(batches: Iterable[Rows], dtype: RowType) -> Iterator[Rows]:
    """Yield the same rows in batches of at most ``BATCH_ROWS``.

    A loop with enough rows begins a batch of its own; so it can be read alone.
    """
    waiting: list[Rows] = []
    count = 0
    for batch in batches:
        if not len(batch):  # a loop without rows
            continue
        begins = count and LOOP in (dtype.names or ()) and waiting[-1][LOOP][-1] != batch[LOOP][0]
        if count >= _LEAST_GROUP_ROWS and begins:
            yield concatenate_rows(waiting, dtype)
            waiting, count = [], 0
        waiting.append(batch)
        count += len(batch)
        if count >= BATCH_ROWS:
            rows = concatenate_rows(waiting, dtype)
            whole = count - count % BATCH_ROWS
            for first in range(0, whole, BATCH_ROWS):
                yield rows[first : first + BATCH_ROWS]
            waiting, count = [rows[whole:].copy()], count - whole
    if count:
        yield concatenate_rows(waiting, dtype)


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


def _values(path: Path, name: str, column: Any, field: np.dtype[Any]) -> NDArray[Any]:
    """Return the values of a column in one chunk; its ``to_numpy`` would import pandas."""
    _require_no_nulls(path, name, column)
    if not len(column):
        return np.zeros(0, field)
    chunk = column.chunk(0)
    return np.frombuffer(memoryview(chunk.buffers()[1]), field, len(chunk), chunk.offset * field.itemsize)


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
    except OSError as error:
        raise CallerError(f"{path}: cannot be read: {why(error)}") from None
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise CallerError(f"{path}: cannot be read: {one_line(error)}") from None


def _require_columns(path: Path, schema: pa.Schema, dtype: RowType) -> None:
    for column, kind in _columns(dtype):
        indices = schema.get_all_field_indices(column)
        if not indices and column == LOOP:
            raise CallerError(
                f"{path}: has no column {LOOP}: an earlier version of noack recorded this run, "
                "which this version does not read"
            )
        if not indices:
            raise CallerError(f"{path}: has no column {column}, which this scenario's runs have")
        if len(indices) > 1 or schema.field(indices[0]).type != kind:
            raise CallerError(f"{path}: column {column} is not one of {kind}")


def _require_no_nulls(path: Path, name: str, column: Any) -> None:
    if column.null_count:
        raise CallerError(f"{path}: column {name} has holes")

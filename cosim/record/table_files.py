"""The files of a record: one Parquet file per table, written and read batch by batch.

Vectors are stored as one column per entry (``x_1``, ``x_2``, …), so every Parquet reader can read
them.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.record.record_source import (
    BATCH_ROWS,
    RecordSource,
    Rows,
    RowsInMemory,
    with_columns,
)
from cosim.record.spool_merge import Segment
from noack.config.resolution import LoopMatrices
from noack.core.errors import CallerError, one_line
from noack.core.file_access import new_file
from noack.protocol.record_tables import OWNER, entry_names

_GROUP_ROWS = 2 * BATCH_ROWS
_ENCODINGS = {pa.int64(): "DELTA_BINARY_PACKED", pa.float64(): "BYTE_STREAM_SPLIT"}
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
        self._counts = {table: self._check(table) for table in types}

    def whole(self, table: str) -> Rows:
        """Read all rows of a table."""
        if table not in self._whole:
            dtype = self.types[table]
            batches = [np.zeros(0, dtype), *read_batches(self.path(table), dtype)]
            self._whole[table] = np.concatenate(batches)
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
            for column, _ in _columns(self.types[table]):
                place = metadata.schema.names.index(column)
                found = [group.column(place).statistics for group in groups]
                if any(one is not None and one.null_count for one in found):
                    raise CallerError(f"{path}: column {column} has holes")
            return int(metadata.num_rows)


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
    names = [column for column, _ in _columns(dtype)]
    with _readable(path), pq.ParquetFile(path) as file:
        _require_columns(path, file.schema_arrow, dtype)
        for group in range(file.num_row_groups):
            # A reader of several groups would keep the memory of all of them to the end.
            for batch in file.iter_batches(BATCH_ROWS, row_groups=[group], columns=names):
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
        return np.concatenate([np.zeros(0, dtype), *(_rows(path, one, dtype) for one in batches)])


def write_table(
    path: Path, batches: Iterable[Rows], dtype: RowType, loop: LoopMatrices | None
) -> None:
    """Write a table's file from batches of rows, in row groups of ``_GROUP_ROWS``.

    ``loop`` names states and inputs; the tables of the network have none.

    Raises:
        OSError: the file cannot be written.
    """
    metadata = {"noack_table": path.stem, "process": OWNER[path.stem]}
    if loop is not None:
        metadata["state_names"] = json.dumps(loop.state_names)
        metadata["input_names"] = json.dumps(loop.input_names)
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


def _regrouped(batches: Iterable[Rows], dtype: RowType) -> Iterator[Rows]:
    """Yield the same rows in batches of ``_GROUP_ROWS``; only the last one may be shorter."""
    waiting: list[Rows] = []
    count = 0
    for batch in batches:
        waiting.append(batch)
        count += len(batch)
        if count >= _GROUP_ROWS:
            rows = np.concatenate(waiting)
            whole = count - count % _GROUP_ROWS
            for first in range(0, whole, _GROUP_ROWS):
                yield rows[first : first + _GROUP_ROWS]
            waiting, count = [rows[whole:].copy()], count - whole
    if count:
        yield np.concatenate([np.zeros(0, dtype), *waiting])


def _arrays(rows: Rows) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.ndim == 2:
            for entry, values in zip(entry_names(name, column.shape[1]), column.T, strict=True):
                columns[entry] = pa.array(np.ascontiguousarray(values))
        elif column.dtype.kind == "V":
            width = column.dtype.itemsize
            raw = pa.py_buffer(np.ascontiguousarray(column).tobytes())
            columns[name] = pa.Array.from_buffers(pa.binary(width), len(rows), [None, raw])
        else:
            columns[name] = pa.array(np.ascontiguousarray(column))
    return columns


def _rows(path: Path, batch: pa.RecordBatch, dtype: RowType) -> Rows:
    rows = np.zeros(batch.num_rows, dtype)
    for name in dtype.names or ():
        field = dtype[name]
        entries = entry_names(name, field.shape[0]) if field.shape else (name,)
        for i, entry in enumerate(entries):
            column = batch.column(entry)
            _require_whole(path, entry, column)
            if field.shape:
                rows[name][:, i] = column.to_numpy()
            else:
                rows[name] = _bytes(column, field) if field.kind == "V" else column.to_numpy()
    return rows


def _bytes(column: Any, field: np.dtype[Any]) -> NDArray[Any]:
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
        if not found:
            raise CallerError(f"{path}: has no column {column}, which this scenario's runs have")
        if len(found) > 1 or schema.field(found[0]).type != kind:
            raise CallerError(f"{path}: column {column} is not one of {kind}")


def _require_whole(path: Path, name: str, column: Any) -> None:
    if column.null_count:
        raise CallerError(f"{path}: column {name} has holes")

"""Converts the spool of a run to its record: all spools merged, without duplicate rows.

A spool is nearly sorted: batches follow each other, except those that were sent again. It is read
in segments of consecutive batches, in the order of their first inputs. The rows of one loop are
merged in bounded memory; of several loops, as many are sorted at once as fit into memory.
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from cosim.record import table_files
from cosim.record.processes import add_kept_reports
from cosim.record.record_writing import record_folder, vector_names
from cosim.record.rows import BATCH_ROWS, Rows, Segment, concatenate_rows
from cosim.record.run_directory import RECORD
from cosim.record.run_record import Notice, RecordedRun, load_run, read_notices, resolved_run
from netem.core.errors import MachineError, PeerError, why
from netem.core.file_access import move, remove_folder
from noack.protocol.record_tables import LOOP, is_of_network
from noack.protocol.roles import LOOP_ROLES, RECORDER
from noack.runtime.control_messages import LogLine, parse_message
from noack.runtime.spool import SPOOL, batch_bytes, batches_in, spool_files, stored_lines

_SEGMENT_BYTES = 1024 * 1024
"""Bytes of consecutive batches that are read at once."""


def spool_segments(spool: Path, table: str, dtype: np.dtype[np.void]) -> Iterator[Segment]:
    """Yield the segments of a table in a spool."""
    for path in spool_files(spool, table):
        for begin, end, rows in spool_parts(path, dtype):
            if len(rows):
                read = partial(_read, path, begin, end, dtype)
                yield Segment(int(rows["input"].min()), int(rows["input"].max()), read)


def spool_parts(
    path: Path, dtype: np.dtype[np.void], begin: int = 0, end: int | None = None
) -> Iterator[tuple[int, int, Rows]]:
    """Yield begin, end and rows of consecutive batches of a file, about a segment at a time.

    The last one may be incomplete: it is left out.
    """
    with path.open("rb", buffering=0) as file:
        end = file.seek(0, os.SEEK_END) if end is None else end
        while begin < end:
            file.seek(begin)
            data = memoryview(file.read(min(_SEGMENT_BYTES, end - begin)))
            batches, complete = batches_in(data)
            if not complete:  # a large batch, or the last one, which is incomplete or damaged
                length = batch_bytes(data)
                if length is None or begin + length > end:
                    return
                file.seek(begin)
                batches, complete = batches_in(memoryview(file.read(length)))
            # Rows of a damaged batch cannot be located.
            whole_batches = [rows for _, rows in batches if len(rows) % dtype.itemsize == 0]
            yield begin, begin + complete, np.frombuffer(b"".join(whole_batches), dtype)
            begin += complete


def _read(path: Path, begin: int, end: int, dtype: np.dtype[np.void]) -> Rows:
    return concatenate_rows([rows for _, _, rows in spool_parts(path, dtype, begin, end)], dtype)


def merge_segments(segments: Iterable[Segment], dtype: np.dtype[np.void]) -> Iterator[Rows]:
    """Yield the rows in the order of the machine's inputs, without duplicates.

    Of several rows with the same input of a loop, the first one is taken.
    """
    in_turn = sorted(segments, key=lambda segment: segment.first)
    waiting: list[Rows] = []
    for segment, next_segment in zip(in_turn, [*in_turn[1:], None], strict=False):
        waiting.append(segment.read())
        if next_segment is not None and sum(map(len, waiting)) < BATCH_ROWS:
            continue
        rows = in_order(concatenate_rows(waiting, dtype))
        ready = len(rows) if next_segment is None else int(np.searchsorted(rows["input"], next_segment.first))
        if ready:
            yield rows[:ready]
        waiting = [rows[ready:]]


def in_order(rows: Rows) -> Rows:
    """Return rows in the order of their inputs, without duplicates."""
    inputs = rows["input"]
    if (np.diff(inputs) > 0).all():
        return rows
    loops = rows[LOOP] if LOOP in (rows.dtype.names or ()) else np.zeros(len(rows), np.uint16)
    order = np.lexsort((loops, inputs))  # stable
    again = (np.diff(inputs[order]) == 0) & (np.diff(loops[order]) == 0)
    return np.asarray(rows.take(order[np.append(True, ~again)]))


def by_loop(segments: Iterable[Segment], dtype: np.dtype[np.void], loops: range) -> list[Rows]:
    """Return the rows of each of some loops, each in order and without duplicates."""
    row_batches = (segment.read() for segment in sorted(segments, key=lambda segment: segment.first))
    parts = [rows.compress((rows[LOOP] >= loops.start) & (rows[LOOP] < loops.stop)) for rows in row_batches]
    rows = concatenate_rows(parts, dtype)
    del parts  # as large as the rows
    rows = rows.take(np.argsort(rows[LOOP], kind="stable"))
    ends = np.searchsorted(rows[LOOP], np.arange(loops.start, loops.stop), "right")
    return [in_order(rows[first:end]) for first, end in zip([0, *ends[:-1]], ends, strict=True)]


_BLOCK_BYTES = 32 * 1024 * 1024
"""Rows of several loops that are sorted at once."""


TableMap = Callable[[Callable[[str], None], Sequence[str]], Iterable[None]]


def finish_record(run_dir: Path, map_tables: TableMap = map) -> RecordedRun:
    """Convert a run's spool to its record, and remove the spool.

    All spools are merged, without duplicate rows. An interrupted attempt can be repeated.

    Args:
        run_dir: the run directory.
        map_tables: ``map_tables(function, tables)`` calls a function for each table, the largest
            first; several processes may do so at once.

    Raises:
        MachineError: the record cannot be written; the spool is kept.
    """
    add_kept_reports(run_dir)
    run = resolved_run(run_dir)
    tables = sorted(run.tables, key=partial(_bytes_of, run_dir), reverse=True)
    notices = _notices(run_dir / RECORD, run_dir / SPOOL, len(run.names))
    try:
        with record_folder(run_dir / RECORD, notices):
            for _ in map_tables(partial(convert_table, run_dir), tables):
                pass  # each table is written as the iteration reaches it
    except OSError as error:
        raise _write_error(run_dir, error) from None
    remove_spool(run_dir)
    return load_run(run_dir)


def convert_table(run_dir: Path, table: str) -> None:
    """Write the record of a table from an earlier record and from the spool.

    Raises:
        OSError: it cannot be written.
    """
    run = resolved_run(run_dir)
    dtype = run.tables[table]
    rows = _rows_loop_after_loop(run_dir, table, dtype, len(run.names))
    table_files.write_table(run_dir / RECORD / f"{table}.parquet", rows, dtype, vector_names(run))


def _bytes_of(run_dir: Path, table: str) -> int:
    """Return the size of the files with the rows of a table."""
    return sum(path.stat().st_size for path in _files_of(run_dir, table))


def _files_of(run_dir: Path, table: str) -> list[Path]:
    path = run_dir / RECORD / f"{table}.parquet"
    return [*spool_files(run_dir / SPOOL, table), *([path] if path.is_file() else [])]


def _rows_loop_after_loop(run_dir: Path, table: str, dtype: np.dtype[np.void], loops: int) -> Iterator[Rows]:
    """Yield the rows of a table from an earlier record and from the spool, loop after loop.

    Of many loops, as many are sorted at once as fit into memory; one loop is never in memory as a
    whole.
    """
    path = run_dir / RECORD / f"{table}.parquet"
    segments = [*table_files.TableFile(path, dtype).segments()] if path.is_file() else []
    segments += spool_segments(run_dir / SPOOL, table, dtype)
    if is_of_network(table):
        yield from merge_segments(segments, dtype)
        return
    at_once = max(loops * _BLOCK_BYTES // max(_bytes_of(run_dir, table), _BLOCK_BYTES), 1)
    for first in range(0, loops, at_once):
        block = range(first, min(first + at_once, loops))
        if len(block) > 1:
            yield from by_loop(segments, dtype, block)
        else:
            yield from merge_segments([segment.of_loop(first) for segment in segments], dtype)


def remove_spool(run_dir: Path) -> None:
    """Remove a run's spool, whose rows are in its record.

    Raises:
        MachineError: it cannot be removed.
    """
    spool = run_dir / SPOOL
    try:
        if spool.is_dir():  # moved in one step, so that an incomplete spool is never read
            spool_to_remove = spool.with_name(f"{SPOOL}.done")
            remove_folder(spool_to_remove)  # of an earlier attempt that was interrupted
            remove_folder(move(spool, spool_to_remove))
    except OSError as error:
        raise _write_error(run_dir, error) from None


def _write_error(run_dir: Path, error: OSError) -> MachineError:
    return MachineError(
        f"{run_dir / RECORD}: the record cannot be written: {why(error)}; what was recorded is "
        f"kept in {run_dir / SPOOL}; later, `noack summary {run_dir}` completes the record"
    )


def _notices(folder: Path, spool: Path, loops: int) -> list[Notice]:
    """Return the lines of the run's log from an earlier record and from the spool, by time."""
    notices = read_notices(folder)
    texts = {json.dumps(notice, sort_keys=True) for notice in notices}
    for role in (*LOOP_ROLES, RECORDER):
        for line in stored_lines(spool, role):
            try:
                notice = parse_message(LogLine, line).fields() | {"process": role}
            except PeerError:  # damaged
                continue
            if notice.get(LOOP, 0) not in range(loops):  # damaged
                continue
            if (text := json.dumps(notice, sort_keys=True)) not in texts:
                texts.add(text)
                notices.append(notice)
    return sorted(notices, key=lambda notice: int(notice["t_ns"]))

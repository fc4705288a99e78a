"""Merges the spooled rows of a table in the order of the machine's inputs, in bounded memory.

A spool is nearly sorted: batches follow each other, except those that were sent again. It is read
in segments of consecutive batches, in the order of their first inputs.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.record.record_source import BATCH_ROWS, Rows, joined
from noack.protocol.record_tables import LOOP
from noack.runtime.spool import batch_bytes, batches_in, spool_files

_SEGMENT_BYTES = 1024 * 1024


class Segment(NamedTuple):
    """Rows of a table that can be read at once; the numbers of their inputs."""

    first: int
    last: int
    read: Callable[[], Rows]


def spool_segments(spool: Path, table: str, dtype: np.dtype[np.void]) -> Iterator[Segment]:
    """Yield the segments of a table in a spool."""
    for path in spool_files(spool, table):
        for begin, end, rows in _parts(path, dtype):
            if len(rows):
                read = partial(_read, path, begin, end, dtype)
                yield Segment(int(rows["input"].min()), int(rows["input"].max()), read)


def _parts(
    path: Path, dtype: np.dtype[np.void], begin: int = 0, end: int | None = None
) -> Iterator[tuple[int, int, Rows]]:
    """Yield begin, end and rows of consecutive batches of a file, about a segment at a time."""
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
            whole = [rows for rows in batches if len(rows) % dtype.itemsize == 0]
            yield begin, begin + complete, np.frombuffer(b"".join(whole), dtype)
            begin += complete


def _read(path: Path, begin: int, end: int, dtype: np.dtype[np.void]) -> Rows:
    return joined([rows for _, _, rows in _parts(path, dtype, begin, end)], dtype)


def merged(segments: Iterable[Segment], dtype: np.dtype[np.void]) -> Iterator[Rows]:
    """Yield the rows in the order of the machine's inputs, without duplicates.

    Of several rows with the same input of a loop, the first one is taken.
    """
    ordered = sorted(segments, key=lambda segment: segment.first)
    waiting: list[Rows] = []
    for segment, after in zip(ordered, [*ordered[1:], None], strict=False):
        waiting.append(segment.read())
        if after is not None and sum(map(len, waiting)) < BATCH_ROWS:
            continue
        rows = in_order(joined(waiting, dtype))
        ready = len(rows) if after is None else int(np.searchsorted(rows["input"], after.first))
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
    return rows.take(order[np.append(True, ~again)])


def by_loop(segments: Iterable[Segment], dtype: np.dtype[np.void], loops: range) -> list[Rows]:
    """Return the rows of each of some loops, each in order and without duplicates."""
    read = (segment.read() for segment in sorted(segments, key=lambda segment: segment.first))
    own = [rows.compress((rows[LOOP] >= loops.start) & (rows[LOOP] < loops.stop)) for rows in read]
    rows = joined(own, dtype)
    rows = rows.take(np.argsort(rows[LOOP], kind="stable"))
    ends = np.searchsorted(rows[LOOP], np.arange(loops.start, loops.stop), "right")
    return [in_order(rows[first:end]) for first, end in zip([0, *ends[:-1]], ends, strict=True)]

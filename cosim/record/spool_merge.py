"""Merges the spooled rows of a table in the order of the machine's inputs, in bounded memory.

A spool is nearly sorted: batches follow each other, except those that were sent again. Consecutive
batches in order form a segment. Segments are read in the order of their first input.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.record_source import BATCH_ROWS, Rows
from noack.protocol.record_tables import LOOP
from noack.runtime.spool import chunks_in, spool_files

_SEGMENT_BYTES = 1024 * 1024


class Segment(NamedTuple):
    """Rows of a table that can be read at once; the numbers of their inputs."""

    first: int
    last: int
    read: Callable[[], Rows]


def spool_segments(spool: Path, table: str, dtype: np.dtype[np.void]) -> Iterator[Segment]:
    """Yield the segments of a table in a spool."""
    for path in spool_files(spool, table):
        begin = end = 0
        low: int | None = None
        high = -1
        for chunk in chunks_in(path):
            inputs = _rows_of(chunk.rows, dtype)["input"]
            if len(inputs):
                first, last = int(inputs.min()), int(inputs.max())
                if low is None:
                    low = first
                elif first <= high or chunk.end - begin > _SEGMENT_BYTES:
                    yield Segment(low, high, partial(_read, path, begin, end, dtype))
                    begin, low = end, first
                high = last
            end = chunk.end
        if low is not None:
            yield Segment(low, high, partial(_read, path, begin, end, dtype))


def merged(
    segments: Iterable[Segment], dtype: np.dtype[np.void], loops: range | None = None
) -> Iterator[Rows]:
    """Yield the rows in the order of the machines' inputs, without duplicates.

    Of several rows with the same input of a loop, the first one is taken. With ``loops``, the rows
    of other loops are left out.
    """
    ordered = sorted(segments, key=lambda one: one.first)
    waiting: list[Rows] = []
    for segment, after in zip(ordered, [*ordered[1:], None], strict=False):
        read = segment.read()
        if loops is not None:
            read = read[(read[LOOP] >= loops.start) & (read[LOOP] < loops.stop)]
        waiting.append(read)
        if after is not None and sum(map(len, waiting)) < BATCH_ROWS:
            continue
        rows = np.concatenate([np.zeros(0, dtype), *waiting])
        rows = rows[_first_places(rows)]
        ready = len(rows) if after is None else int(np.searchsorted(rows["input"], after.first))
        if ready:
            yield rows[:ready]
        waiting = [rows[ready:]]


def _first_places(rows: Rows) -> NDArray[np.intp]:
    """Return the places of the rows in the order of their inputs, without duplicates."""
    if LOOP not in (rows.dtype.names or ()):
        return np.unique(rows["input"], return_index=True)[1]
    order = np.lexsort((rows[LOOP], rows["input"]))  # stable
    inputs, loops = rows["input"][order], rows[LOOP][order]
    repeats = (inputs[1:] == inputs[:-1]) & (loops[1:] == loops[:-1])
    return np.asarray(order[np.append(True, ~repeats)[: len(order)]])


def _read(path: Path, begin: int, end: int, dtype: np.dtype[np.void]) -> Rows:
    chunks = [_rows_of(chunk.rows, dtype) for chunk in chunks_in(path, begin, end)]
    return np.concatenate([np.zeros(0, dtype), *chunks])


def _rows_of(data: bytes, dtype: np.dtype[np.void]) -> Rows:
    """Return the rows of a chunk; none if it is damaged, because they cannot be located."""
    return np.frombuffer(data if len(data) % dtype.itemsize == 0 else b"", dtype)

"""Tables of a run of many loops, written as Parquet while the run goes on.

A table is written in slices of its spool, each loop after loop: one slice at a time is in memory,
and little is left at the end of the run. The spool stays as it is until the record is complete, so
whatever happens to these files, nothing is lost. ``finish_record`` uses a file that has exactly
what the spool has. If rows of a loop did not arrive in order, there are no such files.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from cosim.record.record_source import BATCH_ROWS, Rows, joined
from cosim.record.run_record import scenarios_of, vector_names
from cosim.record.spool_conversion import spool_batches
from cosim.record.table_files import table_writer
from noack.core.process_limits import be_idle, cores
from noack.protocol.record_tables import LOOP
from noack.protocol.topology import RECORDER
from noack.runtime.spool import EARLY, EARLY_ENDED, SPOOL
from noack.scenario.resolution import has_loop, run_tables

_SLICE_BYTES = 32 * 1024 * 1024
_MOST_SLICES = 32
"""Of a longer table, the rows of a loop would be in too many places."""
_POLL_S = 0.05


def write_early(run_dir: Path) -> Mapping[str, int]:
    """Write the tables of the loops of a run: at idle priority until it has ended, then the rest.

    Returns:
        By table: the bytes of its spool whose rows the file has. Without a whole slice, it has none.

    Raises:
        ValueError: rows are missing or not in order, a batch is incomplete, or a table is long.
        OSError: a file cannot be read or written.
    """
    ended = run_dir / SPOOL / EARLY / EARLY_ENDED
    with ExitStack() as stack:
        with ThreadPoolExecutor(1, initializer=be_idle) as thread:
            tables = thread.submit(_opened, run_dir, stack).result()
            thread.submit(_follow, tables, ended).result()
        ended.unlink()
        with ThreadPoolExecutor(cores()) as threads:
            [*threads.map(_EarlyTable.finish, tables)]
    return {one.table: one.bytes for one in tables if one.bytes}


def _opened(run_dir: Path, stack: ExitStack) -> "list[_EarlyTable]":
    """Open the tables of the loops, in a new folder."""
    scenario, loops = scenarios_of(run_dir)
    folder, names = run_dir / SPOOL / EARLY, vector_names(scenario)
    folder.mkdir()
    tables = []
    for table, dtype in run_tables(scenario).items():
        spool = run_dir / SPOOL / f"{table}.{RECORDER}"
        if has_loop(table) and spool.exists():
            file = table_writer(folder / f"{table}.parquet", dtype, names)
            tables.append(_EarlyTable(spool, dtype, len(loops), stack.enter_context(file)))
    return tables


def _follow(tables: "Sequence[_EarlyTable]", ended: Path) -> None:
    while not ended.exists():
        # The first that can: a slice is written before the next one is read.
        if not any(one.advance(ended=False) for one in tables):
            time.sleep(_POLL_S)


class _EarlyTable:
    """A table that is written as its spool grows.

    Args:
        spool: the file of its spool.
        dtype: the type of its rows.
        loops: the number of loops.
        write: writes a row group.
    """

    def __init__(
        self, spool: Path, dtype: np.dtype[np.void], loops: int, write: Callable[[Rows], None]
    ) -> None:
        self.table, self.bytes = spool.stem, 0
        self._spool, self._dtype, self._write = spool, dtype, write
        self._next, self._waiting = 0, dict[int, Rows]()
        """The number of the next row, and later batches, by the number of their first row."""
        self._newest = np.full(loops, -1, np.int64)
        """The newest input of each loop."""
        self._groups: Iterator[Rows] = iter(())
        """The row groups of a slice that are still to be written."""

    def advance(self, *, ended: bool) -> bool:
        """Write the next row group, if there is one: the last slice can be short."""
        while (rows := next(self._groups, None)) is None:
            if self._spool.stat().st_size - self.bytes < (1 if ended else _SLICE_BYTES):
                return False
            self._groups = self._slice()
        self._write(rows)
        return True

    def finish(self) -> None:
        """Write the rest of a table that has been begun."""
        while self.bytes and self.advance(ended=True):
            pass
        if self._waiting:
            raise ValueError("rows are missing")

    def _consecutive(self) -> Iterator[Rows]:
        """Yield the next rows of the spool, in which a batch that was sent again comes late."""
        begin = self.bytes
        if begin >= _MOST_SLICES * _SLICE_BYTES:
            raise ValueError("the table is long")
        if sum(map(len, self._waiting.values())) * self._dtype.itemsize > _SLICE_BYTES:
            raise ValueError("rows are missing")
        for _, end, batches in spool_batches(self._spool, self._dtype, begin):
            self._waiting |= {first: np.frombuffer(rows, self._dtype) for first, rows in batches}
            self.bytes = end
            if end - begin >= _SLICE_BYTES:
                break
        if self.bytes == begin:
            raise ValueError("a batch is incomplete")
        for first in sorted(self._waiting):
            if first > self._next:
                break
            rows = self._waiting.pop(first)
            if first == self._next:  # otherwise it came twice
                self._next += len(rows)
                yield rows

    def _slice(self) -> Iterator[Rows]:
        """Yield the next rows of the spool, loop after loop."""
        rows = joined([*self._consecutive()], self._dtype)
        rows = rows.take(np.argsort(rows[LOOP], kind="stable"))
        loops, inputs = rows[LOOP].astype(np.int64), rows["input"]
        firsts = np.flatnonzero(np.diff(loops, prepend=-1))
        before = np.append(-1, inputs)[:-1]
        before[firsts] = self._newest[loops[firsts]]  # IndexError: damaged
        if not (inputs > before).all():
            raise ValueError("rows of a loop are not in order")
        lasts = np.append(firsts[1:], len(rows))[: len(firsts)] - 1
        self._newest[loops[firsts]] = inputs[lasts]
        # Loops in groups of a power of 2: so reading some loops rarely reads many others.
        most = max(int(np.diff(firsts, append=len(rows)).max(initial=1)), 1)
        at_once = 2 ** max((BATCH_ROWS // most).bit_length() - 1, 0)
        ends = np.searchsorted(loops, np.arange(at_once, len(self._newest) + at_once, at_once))
        for begin, end in zip([0, *ends[:-1]], ends, strict=True):
            for first in range(begin, end, BATCH_ROWS):
                yield rows[first : min(first + BATCH_ROWS, end)]

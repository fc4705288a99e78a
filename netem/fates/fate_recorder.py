"""The tap that records a fate trace; it has its own thread."""

import os
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from netem.engine.relay_interface import DIRECTIONS, LinkSpec
from netem.fates.fate_trace import NUMBERS, SCHEMA, description
from netem.relay_events import EVENT
from netem.standard_error import say
from noack.core.errors import CallerError
from noack.core.file_access import open_growing, open_regular

_FIELDS = {"arrival_ns": "t_ns"}
"""Fields of an event whose columns have another name."""
_RAW = np.dtype((np.void, EVENT.itemsize))
"""Events as raw bytes; numpy copies these ten times as fast as records with fields."""
_GROUP_ROWS = 65_536
_MAGIC = b"PAR1"
_MAX_WAITING = 1_000_000


class FateRecorder:
    """Writes a trace within the context.

    The relay never waits: an event that cannot be queued is counted as missing. A trace with
    missing events cannot be replayed; a line on standard error reports the first one immediately.

    Args:
        path: the file; it is replaced, and is complete when the context has ended.
        specs: the relay's links, in its order.
        max_waiting: maximum number of queued rows.

    Raises:
        CallerError: the file cannot be written, or is not a Parquet file.
    """

    wants_data = False

    def __init__(
        self, path: Path, specs: Sequence[LinkSpec], max_waiting: int = _MAX_WAITING
    ) -> None:
        self._path = path
        self._specs = specs
        self._names = (pa.array([spec.name for spec in specs]), pa.array(DIRECTIONS))
        self._columns = {
            name: np.empty(_GROUP_ROWS, kind)
            for name, kind in {"link": "int16", "direction": "int16", **NUMBERS}.items()
        }
        self._gathered = 0
        self._max_waiting = max_waiting
        self._queue: SimpleQueue[NDArray[Any] | str | None] = SimpleQueue()
        self._taken = 0
        self._done = 0
        self._missed = 0
        self._unwritten = 0
        self._failed = False
        with suppress(OSError, ValueError), open_regular(path) as file:
            if file.read(len(_MAGIC)) not in (b"", _MAGIC):
                raise CallerError(
                    f"--record-fates {path}: exists and is not a Parquet file; choose another name"
                )
        try:
            descriptor = open_growing(path, follow=True)
            try:  # by its descriptor, as pyarrow would follow a link
                self._writer = pq.ParquetWriter(f"/dev/fd/{descriptor}", SCHEMA)
            finally:
                os.close(descriptor)
        except (OSError, ValueError) as error:
            raise CallerError(
                f"--record-fates {path}: cannot be written ({_reason(error)})"
            ) from None
        self._thread = threading.Thread(target=self._run, name="fates", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        self._thread.join()

    @property
    def rows(self) -> int:
        """Number of rows in the file; valid after the context."""
        return self._done - self._unwritten

    @property
    def missing_events(self) -> int:
        """Number of events that are not in the trace."""
        return self._missed + self._unwritten

    def take(self, events: NDArray[Any], data: NDArray[np.uint8]) -> None:
        """Queue the arrivals; called in the relay's thread."""
        try:
            rows = events.view(_RAW)[events["departure"] == 0]
        except MemoryError:
            self.missing(len(events))
            return
        if self._taken - self._done + len(rows) > self._max_waiting:
            self.missing(len(rows))
        elif len(rows):
            self._taken += len(rows)
            self._queue.put(rows)

    def missing(self, events: int) -> None:
        """Count events for which the relay had no room; called in its thread."""
        if self._missed == 0 and events:
            self._queue.put("events are missing: they arrive faster than they can be written")
        self._missed += events

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            if isinstance(item, str):
                self._report(item)
            else:
                self._gather(item.view(EVENT))
        if self._gathered:
            self._write()
        self._end()

    def _gather(self, rows: NDArray[Any]) -> None:
        """Copy rows into columns, in groups, to release the interpreter lock often."""
        while len(rows):
            part, rows = np.split(rows, [_GROUP_ROWS - self._gathered])
            here = slice(self._gathered, self._gathered + len(part))
            for name, column in self._columns.items():
                column[here] = part[_FIELDS.get(name, name)]
            self._gathered += len(part)
            if self._gathered == _GROUP_ROWS:
                self._write()

    def _write(self) -> None:
        rows, self._gathered = self._gathered, 0
        if not self._failed:
            columns: list[pa.Array[Any]] = [
                pa.DictionaryArray.from_arrays(self._columns[name][:rows], names)
                for name, names in zip(("link", "direction"), self._names, strict=True)
            ]
            columns += [pa.array(self._columns[name][:rows]) for name in NUMBERS]
            try:
                self._writer.write_table(pa.Table.from_arrays(columns, schema=SCHEMA))
            except OSError as error:
                self._fail(error)
        if self._failed:
            self._unwritten += rows
        self._done += rows

    def _end(self) -> None:
        try:
            self._writer.add_key_value_metadata(description(self._specs, self.missing_events))
            self._writer.close()
        except OSError as error:
            self._fail(error)
            self._unwritten = self._done

    def _fail(self, error: OSError) -> None:
        if not self._failed:
            self._failed = True
            self._report(f"cannot be written ({_reason(error)})")

    def _report(self, what: str) -> None:
        say(f"fate trace {self._path}: {what}; it cannot be replayed; the relay continues")


def _reason(error: OSError | ValueError) -> str:
    # Arrow's message ends with "[errno 28] No space left on device".
    return str(error).rpartition("] ")[2]

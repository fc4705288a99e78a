"""Records fate traces: a tap of the relay that writes in a thread of its own."""

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

_FIELDS = {"arrival_ns": "t_ns"}
"""From a trace's columns to the fields of an event, where they differ."""
_RAW = np.dtype((np.void, EVENT.itemsize))
"""Events without their fields, as which numpy copies them ten times as fast."""
_GROUP_ROWS = 65_536
_MAGIC = b"PAR1"
_MOST_WAITING = 1_000_000


class FateRecorder:
    """Writes a trace while the context lasts.

    It never holds up the relay: what it cannot take is counted as missing. A trace with holes
    cannot be replayed, so that the first one is told at once, in a line on standard error.

    Args:
        path: the file, which is replaced; it can be read when the context has ended.
        specs: the relay's links, in its order.
        most_waiting: at most so many rows wait to be written.

    Raises:
        CallerError: the file cannot be written, or is another program's.
    """

    wants_data = False

    def __init__(
        self, path: Path, specs: Sequence[LinkSpec], most_waiting: int = _MOST_WAITING
    ) -> None:
        self._path = path
        self._specs = specs
        self._names = (pa.array([spec.name for spec in specs]), pa.array(DIRECTIONS))
        self._columns = {
            name: np.empty(_GROUP_ROWS, kind)
            for name, kind in {"link": "int16", "direction": "int16", **NUMBERS}.items()
        }
        self._gathered = 0
        self._most_waiting = most_waiting
        self._queue: SimpleQueue[NDArray[Any] | str | None] = SimpleQueue()
        self._taken = 0
        self._done = 0
        self._missed = 0
        self._unwritten = 0
        self._failed = False
        _check_overwriting(path)
        try:
            self._writer = pq.ParquetWriter(path, SCHEMA)
        except OSError as error:
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
        """Rows in the file, when the context has ended."""
        return self._done - self._unwritten

    @property
    def missing_events(self) -> int:
        """How many events are not in the trace; of 0 it is whole."""
        return self._missed + self._unwritten

    def take(self, events: NDArray[Any], data: NDArray[np.uint8]) -> None:
        """Take what has come in; called in the relay's thread."""
        try:
            rows = events.view(_RAW)[events["departure"] == 0]
        except MemoryError:
            self.missing(len(events))
            return
        if self._taken - self._done + len(rows) > self._most_waiting:
            self.missing(len(rows))
        elif len(rows):
            self._taken += len(rows)
            self._queue.put(rows)

    def missing(self, events: int) -> None:
        """Take note that events were lost; called in the relay's thread."""
        if self._missed == 0 and events:
            self._queue.put("events are missing, as they come faster than they are written")
        self._missed += events

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            if isinstance(item, str):
                self._tell(item)
            else:
                self._gather(item.view(EVENT))
        if self._gathered:
            self._write()
        self._end()

    def _gather(self, rows: NDArray[Any]) -> None:
        """Put rows into columns, batch by batch: the interpreter is never held for long."""
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
            self._tell(f"cannot be written any more ({_reason(error)})")

    def _tell(self, what: str) -> None:
        say(f"fate trace {self._path}: {what}; it cannot be replayed, the relay goes on")


def _check_overwriting(path: Path) -> None:
    """Refuse to overwrite what was not written by one like this."""
    with suppress(OSError), path.open("rb") as file:
        if path.is_file() and file.read(len(_MAGIC)) not in (b"", _MAGIC):
            raise CallerError(
                f"--record-fates {path}: is there already, and no Parquet file; take another name"
            )


def _reason(error: OSError) -> str:
    # Arrow says where in its code it failed, and then "[errno 28] No space left on device".
    return str(error).rpartition("] ")[2]

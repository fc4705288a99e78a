"""The tap that writes a capture. It has its own thread: the packet path never waits for a disk."""

import os
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.capture.pcapng import PcapngSection
from netem.engine.relay_interface import LinkSpec
from netem.relay_events import Bytes, Events
from noack.core.errors import CallerError, why
from noack.core.file_access import open_growing
from noack.runtime.address import text_of

_STDOUT = 1


class _Batch(NamedTuple):
    events: Events
    data: Bytes
    missing: NDArray[np.int64]
    """(interfaces,) Number of missing events before this batch."""


class CaptureWriter:
    """An open capture file.

    Create it before the packet path applies its real-time settings: the new thread would inherit
    them. Each link has two interfaces: the clients' side, then the server's.

    Args:
        path: the file, which is replaced; a FIFO; ``-`` for standard output.
        specs: the relay's links.
        batches: maximum number of queued batches.

    Raises:
        CallerError: the file cannot be opened, or standard output is a terminal.
    """

    wants_data = True

    def __init__(self, path: str | Path, specs: Sequence[LinkSpec], *, batches: int = 64) -> None:
        self.error: str | None = None
        """Why the capture ended early, in one line; None if it did not."""
        self._section = PcapngSection(
            [
                (f"{spec.name} {side}", text_of(address))
                for spec in specs
                for side, address in (("client", spec.listen), ("server", spec.to))
            ]
        )
        self._path = "standard output" if str(path) == "-" else str(path)
        self._file = _open(path)
        self._batches = batches
        self._queue: SimpleQueue[_Batch | None] = SimpleQueue()
        self._unreported = np.zeros(2 * len(specs), np.int64)
        self._received_events = 0
        self._missing_events = 0
        self._written = 0
        self._bytes = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    @property
    def missing_events(self) -> int:
        """Number of events that will not be in the file."""
        if self.error is not None:
            return self._received_events - self._written
        return self._missing_events

    @property
    def written(self) -> int:
        """Number of events in the file."""
        return self._written

    def take(self, events: Events, data: Bytes) -> None:
        """Queue a copy of a batch; never waits."""
        self._received_events += events.size
        if self._closed or self.error is not None:
            self._missing_events += events.size
            return
        if self._queue.qsize() < self._batches:
            with suppress(MemoryError):
                self._queue.put(_Batch(events.copy(), data.copy(), self._unreported))
                self._unreported = np.zeros_like(self._unreported)
                return
        self._unreported += np.bincount(events["interface"], minlength=self._unreported.size)
        self._missing_events += events.size

    def close(self, patience_s: float = 5.0) -> None:
        """Write the queued batches and the statistics, and close the file.

        It waits for ``patience_s`` for a disk or a reader that accepts nothing.
        """
        if not self._closed:
            self._closed = True
            self._queue.put(None)
        before = -1
        while self._thread.is_alive() and self._bytes != before:
            before = self._bytes
            self._thread.join(patience_s)
        if self._thread.is_alive() and self.error is None:
            self._fail(f"nothing could be written for {patience_s:g} s")

    def _run(self) -> None:
        try:
            self._write(self._section.header())
            while self.error is None and (batch := self._queue.get()) is not None:
                self._section.miss(batch.missing)
                self._write(self._section.packets(batch.events, batch.data))
                self._written += batch.events.size
            if self.error is None:
                self._section.miss(self._unreported)
                self._write(self._section.statistics())
        except (OSError, ValueError) as error:
            self._fail(getattr(error, "strerror", None) or str(error))
        finally:
            os.close(self._file)

    def _write(self, blocks: bytes | memoryview) -> None:
        view = memoryview(blocks)
        done = 0
        try:
            while done < len(view):
                size = os.write(self._file, view[done:])
                done += size
                self._bytes += size
        except OSError:
            with suppress(OSError):  # remove an incomplete block; a pipe cannot be truncated
                os.ftruncate(self._file, os.lseek(self._file, 0, os.SEEK_CUR) - done)
            raise

    def _fail(self, reason: str) -> None:
        self.error = f"{self._path}: the capture ends after {self._written} events: {reason}"


def _open(path: str | Path) -> int:
    if str(path) == "-":
        if os.isatty(_STDOUT):
            raise CallerError(
                "a capture cannot go to a terminal: name a file, or use a pipe, "
                "for example `| wireshark -k -i -`"
            )
        return os.dup(_STDOUT)
    try:
        return open_growing(Path(path), follow=True)
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: the capture cannot be opened: {why(error)}") from None

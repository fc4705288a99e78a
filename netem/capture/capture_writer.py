"""Writes a capture in a thread of its own, so that the packet path never waits for the disk."""

import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from netem.capture.packet_blocks import Bytes, Events
from netem.capture.pcapng import SNAP_BYTES, PcapngInterface, PcapngSection
from noack.core.errors import CallerError

_STDOUT = 1


class _Batch(NamedTuple):
    events: Events
    data: Bytes
    missing: NDArray[np.int64] | None
    """Events that are missing before this batch, per interface."""


class CaptureWriter:
    """An open capture file.

    Make it before the packet path takes its real-time settings: it may compile for some seconds,
    and its thread would inherit them. One thread at a time may offer batches and close.

    Args:
        path: the file, which is replaced; a FIFO, which must have or get a reader; ``-`` for the
            standard output.
        interfaces: what an event's ``interface`` indexes.
        snap_bytes: payload bytes captured of each datagram.
        batches: how many batches may wait to be written.
        returned: called in the writer's thread with the arrays of each batch that it needs no more.

    Raises:
        CallerError: the file cannot be opened, or the standard output is a terminal.
    """

    def __init__(
        self,
        path: str | Path,
        interfaces: Sequence[PcapngInterface],
        *,
        snap_bytes: int = SNAP_BYTES,
        batches: int = 64,
        returned: Callable[[Events, Bytes], None] | None = None,
    ) -> None:
        self.error: str | None = None
        """Why the capture ended early, in one line; None as long as it has not."""
        self._section = PcapngSection(interfaces, snap_bytes)
        self._path = "the standard output" if str(path) == "-" else str(path)
        self._file = _open(path)
        self._batches = batches
        self._returned = returned
        self._queue: SimpleQueue[_Batch | None] = SimpleQueue()
        self._untold = np.zeros(len(interfaces), np.int64)
        self._some_untold = False
        self._offered = 0
        self._missing = 0
        self._written = 0
        self._bytes = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    @property
    def missing(self) -> int:
        """Events that were offered and are not in the file, nor on their way into it."""
        return self._missing if self.error is None else self._offered - self._written

    @property
    def written(self) -> int:
        """Events in the file."""
        return self._written

    def offer(self, events: Events, data: Bytes) -> bool:
        """Hand over a batch; never waits.

        Args:
            events: shape (n,), of type :data:`netem.relay_events.EVENT`, n ≥ 1.
            data: their payloads.

        Returns:
            Whether it was taken. Then the arrays must not change until they are returned.
            Otherwise its events are missing from the file, which says so.
        """
        if self._closed or self.error is not None:
            self._count_missing(events.size)
            return False
        if self._queue.qsize() >= self._batches:
            self.miss(np.bincount(events["interface"], minlength=self._untold.size))
            return False
        self._offered += events.size
        missing = None
        if self._some_untold:
            missing, self._untold = self._untold, np.zeros_like(self._untold)
            self._some_untold = False
        self._queue.put(_Batch(events, data, missing))
        return True

    def miss(self, events: NDArray[np.int64]) -> None:
        """Count events that could not even be offered, per interface, shape (interfaces,)."""
        self._untold += events
        self._some_untold = True
        self._count_missing(int(events.sum()))

    def _count_missing(self, events: int) -> None:
        self._offered += events
        self._missing += events

    def close(self, patience_s: float = 5.0) -> None:
        """Write what waits and the statistics, and close.

        Args:
            patience_s: how long to wait for a disk or a reader that takes nothing.
        """
        if not self._closed:
            self._closed = True
            self._queue.put(None)
        before = -1
        while self._thread.is_alive() and self._bytes != before:
            before = self._bytes
            self._thread.join(patience_s)
        if self._thread.is_alive() and self.error is None:
            self._fail(f"it has taken nothing for {patience_s:g} s")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _run(self) -> None:
        self._attempt(lambda: self._write(self._section.header()))
        while (batch := self._queue.get()) is not None:
            self._attempt(partial(self._take, batch))
            if self._returned is not None:
                self._returned(batch.events, batch.data)
        self._attempt(self._finish)
        os.close(self._file)

    def _attempt(self, step: Callable[[], None]) -> None:
        """Take a step, unless the capture has ended; whatever fails ends it."""
        if self.error is not None:
            return
        try:
            step()
        except OSError as error:
            self._fail(error.strerror or str(error))
        except ValueError as error:
            self._fail(str(error))

    def _take(self, batch: _Batch) -> None:
        if batch.missing is not None:
            self._section.miss(batch.missing)
        self._write(self._section.packets(batch.events, batch.data))
        self._written += batch.events.size

    def _finish(self) -> None:
        self._section.miss(self._untold)
        self._write(self._section.statistics())

    def _write(self, blocks: bytes | memoryview) -> None:
        view = memoryview(blocks)
        done = 0
        try:
            while done < len(view):
                size = os.write(self._file, view[done:])
                done += size
                self._bytes += size
        except OSError:
            with suppress(OSError):  # a file must not end in half a block; a pipe cannot be cut
                os.ftruncate(self._file, os.lseek(self._file, 0, os.SEEK_CUR) - done)
            raise

    def _fail(self, reason: str) -> None:
        self.error = f"{self._path}: the capture ends after {self._written} events: {reason}"


def _open(path: str | Path) -> int:
    if str(path) == "-":
        if os.isatty(_STDOUT):
            raise CallerError(
                "a capture is not for a terminal: give a file, or pipe it, "
                "for example `| wireshark -k -i -`"
            )
        return os.dup(_STDOUT)
    try:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise CallerError(f"{path}: the capture cannot be opened: {error.strerror}") from None

"""A pcapng file of the emulator: one section with interfaces, packets, and final statistics.

An interface is one side of a link. ``inbound`` packets are datagrams that the emulator received,
``outbound`` packets are datagrams that it forwarded. Each packet has a comment::

    delivered | dropped by the loss model | forced: delivered as the first of its flow |
    forced: delivered by the cap of 4 consecutive losses |
    corrupted in bit 513 | dropped by a full queue | dropped in a blackout
    [, consecutive loss 2, cap 4] [, delayed 10.5 ms] [, held back 1.2 ms for the guarantee]
    ; forward, flow 3, packet 17

The comment of an outbound packet has its actual delay instead (``, after 10.613 ms``). Where they
apply, it also has ``copy, ...`` and ``delivered out of order (stale)``. A datagram has the same
packet id at both interfaces. The packets are formatted by ``native/relay/capture.c``.

Source: draft-ietf-opsawg-pcapng.
"""

import os
import platform
import struct
import threading
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import EVENT, Bytes, Events
from noack.core.core_library import core, ffi, pointer_to
from noack.core.errors import CallerError, why
from noack.core.file_access import open_growing
from noack.runtime.address import address_text

_SNAP_BYTES = 262_144
"""Larger than any datagram: payloads are captured completely."""

_LINKTYPE_RAW = 101
"""Packets that begin with their IP header."""
_SECTION, _INTERFACE, _STATISTICS = 0x0A0D0D0A, 1, 5
"""Types of pcapng's blocks."""
_HARDWARE, _OS, _APPLICATION = 2, 3, 4
"""Options of a section header."""
_NAME, _DESCRIPTION, _RESOLUTION = 2, 3, 9
"""Options of the description of an interface."""
_START, _END, _RECEIVED, _DROPPED = 2, 3, 4, 5
"""Options of the statistics of an interface."""


class Interface(NamedTuple):
    """A side of a link."""

    name: str
    description: str


class PcapngSection:
    """The blocks of one capture file, in file order: header, packets, ..., statistics.

    Args:
        interfaces: each side of each link; the ``interface`` of an event is an index into them.
    """

    def __init__(self, interfaces: Sequence[Interface]) -> None:
        self._interfaces = tuple(interfaces)
        self._missing = np.zeros(len(interfaces), np.int64)
        self._all_missing = np.zeros(len(interfaces), np.int64)
        self._written_packets = np.zeros(len(interfaces), np.int64)
        self._start_ns = 0
        self._end_ns = 0
        self._out = np.empty(0, np.uint8)

    def header(self) -> bytes:
        """Return the section header and the interface descriptions."""
        blocks = [
            _block(
                _SECTION,
                struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1),
                (_HARDWARE, platform.machine().encode()),
                (_OS, f"{platform.system()} {platform.release()}".encode()),
                (_APPLICATION, f"noack netem {version('noack')}".encode()),
            )
        ]
        blocks += [
            _block(
                _INTERFACE,
                struct.pack("<HHI", _LINKTYPE_RAW, 0, _SNAP_BYTES),
                (_NAME, name.encode()),
                (_DESCRIPTION, description.encode()),
                (_RESOLUTION, b"\x09"),
            )
            for name, description in self._interfaces
        ]
        return b"".join(blocks)

    def packets(self, events: Events, data: Bytes) -> memoryview:
        """Return the events' packets, which are valid until the next call.

        Another thread of Python goes on meanwhile.

        Raises:
            ValueError: an event has an unknown interface, is too large, or points beyond the data.
        """
        events = np.require(events, EVENT, ["C", "A"])
        data = np.require(data, np.uint8, "C")
        rows = pointer_to(events, "noack_event *")
        wrong = core.noack_capture_check(rows, events.size, data.size, len(self._interfaces))
        if wrong != ffi.NULL:
            raise ValueError(f"a batch is impossible: {ffi.string(wrong).decode()}")
        most_bytes = int(events["size_bytes"].sum()) + core.NOACK_CAPTURE_BYTES * events.size
        if most_bytes > self._out.size:
            self._out = np.empty(most_bytes, np.uint8)
        if events.size:
            self._start_ns = self._start_ns or int(events["t_ns"][0])
            self._end_ns = int(events["t_ns"][-1])
        size = core.noack_capture_blocks(
            rows,
            events.size,
            pointer_to(data, "uint8_t *"),
            pointer_to(self._missing, "int64_t *"),
            pointer_to(self._written_packets, "int64_t *"),
            pointer_to(self._out, "uint8_t *"),
        )
        return self._out.data[:size]

    def add_missing(self, events: NDArray[np.int64]) -> None:
        """Note (interfaces,) numbers of events that are missing at this place of the file."""
        self._missing += events
        self._all_missing += events

    def statistics(self) -> bytes:
        """Return the numbers of received and of missing packets per interface."""
        return b"".join(
            _block(
                _STATISTICS,
                struct.pack("<I", index) + _time(self._end_ns),
                (_START, _time(self._start_ns)),
                (_END, _time(self._end_ns)),
                (_RECEIVED, struct.pack("<q", written + missing)),
                (_DROPPED, struct.pack("<q", missing)),
            )
            for index, (written, missing) in enumerate(
                zip(self._written_packets, self._all_missing, strict=True)
            )
        )


def _time(t_ns: int) -> bytes:
    return struct.pack("<II", t_ns >> 32, t_ns & 0xFFFF_FFFF)


def _block(kind: int, body: bytes, *options: tuple[int, bytes]) -> bytes:
    for code, value in options:
        if value:
            body += struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)
    body += struct.pack("<HH", 0, 0)  # end of options
    size = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + size + body + size


_STDOUT = 1


class _Batch(NamedTuple):
    events: Events
    data: Bytes
    missing: NDArray[np.int64]  # (interfaces,) Number of missing events before this batch


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
                Interface(f"{spec.name} {side}", address_text(address))
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
        self._written_events = 0
        self._bytes = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    @property
    def missing_events(self) -> int:
        """Number of events that will not be in the file."""
        if self.error is not None:
            return self._received_events - self._written_events
        return self._missing_events

    @property
    def written_events(self) -> int:
        """Number of events in the file."""
        return self._written_events

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
        earlier_bytes = -1
        while self._thread.is_alive() and self._bytes != earlier_bytes:
            earlier_bytes = self._bytes
            self._thread.join(patience_s)
        if self._thread.is_alive() and self.error is None:
            self._fail(f"nothing could be written for {patience_s:g} s")

    def _run(self) -> None:
        try:
            self._write(self._section.header())
            while self.error is None and (batch := self._queue.get()) is not None:
                self._section.add_missing(batch.missing)
                self._write(self._section.packets(batch.events, batch.data))
                self._written_events += batch.events.size
            if self.error is None:
                self._section.add_missing(self._unreported)
                self._write(self._section.statistics())
        except (OSError, ValueError) as error:
            self._fail(getattr(error, "strerror", None) or str(error))
        finally:
            os.close(self._file)

    def _write(self, blocks: bytes | memoryview) -> None:
        view = memoryview(blocks)
        written_bytes = 0
        try:
            while written_bytes < len(view):
                size = os.write(self._file, view[written_bytes:])
                written_bytes += size
                self._bytes += size
        except OSError:
            with suppress(OSError):  # remove an incomplete block; a pipe cannot be truncated
                os.ftruncate(self._file, os.lseek(self._file, 0, os.SEEK_CUR) - written_bytes)
            raise

    def _fail(self, reason: str) -> None:
        self.error = f"{self._path}: the capture ends after {self._written_events} events: {reason}"


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

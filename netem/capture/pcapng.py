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

import platform
import struct
from collections.abc import Sequence
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from netem.relay_events import EVENT, Bytes, Events
from noack.core.core_library import core, ffi, pointer_to

_SNAP_BYTES = 262_144
"""Larger than any datagram: payloads are captured completely."""

_LINKTYPE_RAW = 101
_SECTION, _INTERFACE, _STATISTICS = 0x0A0D0D0A, 1, 5
_HARDWARE, _OS, _APPLICATION = 2, 3, 4
_NAME, _DESCRIPTION, _RESOLUTION = 2, 3, 9
_START, _END, _RECEIVED, _DROPPED = 2, 3, 4, 5


class PcapngSection:
    """The blocks of one capture file, in file order: header, packets, ..., statistics.

    Args:
        interfaces: name and description of each side of each link; the ``interface`` of an event
            is an index into them.
    """

    def __init__(self, interfaces: Sequence[tuple[str, str]]) -> None:
        self._interfaces = tuple(interfaces)
        self._missing = np.zeros(len(interfaces), np.int64)
        self._all_missing = np.zeros(len(interfaces), np.int64)
        self._written = np.zeros(len(interfaces), np.int64)
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
            rows, events.size, pointer_to(data, "uint8_t *"),
            pointer_to(self._missing, "int64_t *"), pointer_to(self._written, "int64_t *"),
            pointer_to(self._out, "uint8_t *"),
        )  # fmt: skip
        return self._out.data[:size]

    def miss(self, events: NDArray[np.int64]) -> None:
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
                zip(self._written, self._all_missing, strict=True)
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

"""The load of the relay benchmarks: ``load.c``, built with ``cc`` and called through ctypes.

The calling process is sender and sink of every relay. Arrival times are the kernel's timestamps, so
that they do not depend on the time at which the sink is read.
"""

import ctypes
import os
import socket
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks._programs import compiled
from benchmarks._report import MeasurementError

DATAGRAM_BYTES = 72
LOOPBACK = "127.0.0.1"
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SINK_BUFFER_BYTES = 64 * 1024 * 1024
_KERNEL_BYTES = 1024
"""Upper bound on the bytes of a receive buffer that a small datagram occupies."""
_PATIENCE_NS = 300_000_000
"""After this time without an arrival, the rest of a burst counts as lost."""
_PING_TIMEOUT_S = 0.2

_INT, _LONG, _AT = ctypes.c_int, ctypes.c_int64, ctypes.c_void_p
_SIGNATURES = {
    "load_burst": (_INT, _INT, _INT, _LONG, _LONG, _LONG, _AT, _LONG, _LONG, _LONG, _AT),
    "load_direct": (_INT, _INT, _LONG, _LONG, _LONG, _LONG, _AT, _AT),
    "load_ping": (_INT, _INT, _LONG, _LONG, _LONG, _AT),
    "load_pace": (_INT, _LONG, _LONG, _LONG, _LONG, _AT),
    "load_collect": (_INT, _LONG, _LONG, _LONG, _AT),
    "load_soak": (_INT, _INT, _LONG, _LONG, _LONG, _LONG, _AT),
}

Nanoseconds = npt.NDArray[np.int64]


class Burst(NamedTuple):
    """Result of a burst."""

    wall_s: float
    """Time from the relay's continuation to the last arrival."""
    decided: int
    """Datagrams up to the last one that arrived: the relay has received and decided these."""
    received: int
    """Datagrams that arrived."""


class _Burst(ctypes.Structure):
    _fields_ = (
        ("wall_ns", ctypes.c_int64),
        ("last", ctypes.c_int64),
        ("received", ctypes.c_int64),
    )

    def result(self) -> Burst:
        return Burst(self.wall_ns * 1e-9, self.last + 1, self.received)


class Soak(ctypes.Structure):
    """Counts of a steady load, carried from one call to the next."""

    _fields_ = (
        ("sent", ctypes.c_int64),
        ("received", ctypes.c_int64),
        ("next", ctypes.c_int64),
        ("longest_gap", ctypes.c_int64),
        ("disordered", ctypes.c_int64),
    )
    sent: int
    received: int
    next: int
    """The number that would arrive next without a loss."""
    longest_gap: int
    """Maximum number of consecutive datagrams that did not arrive."""
    disordered: int
    """Arrivals after a later datagram."""


class Built(NamedTuple):
    """The code compiled for a benchmark."""

    load: ctypes.CDLL
    relay: Path


@contextmanager
def built() -> Iterator[Built]:
    """Compile the load and the C relay; they exist within the context.

    Raises:
        MeasurementError: there is no C compiler, or it fails.
    """
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        load = compiled("load.c", Path(folder), "-shared", "-fPIC")
        relay = compiled("relay.c", Path(folder))
        library = ctypes.CDLL(str(load))
        for name, types in _SIGNATURES.items():
            getattr(library, name).argtypes = types
        yield Built(library, relay)


def sources(count: int) -> npt.NDArray[np.uint32]:
    """``count`` loopback addresses (127.1.0.0 and on) in network byte order, for the C code."""
    return (np.uint32(0x7F010000) + np.arange(count, dtype=np.uint32)).astype(">u4").view(np.uint32)


class Ends:
    """Both ends of a path through a relay: a sender connected to it, and the sink behind it.

    All datagrams are numbered consecutively from 0.

    Args:
        load: the compiled load.
    """

    def __init__(self, load: ctypes.CDLL) -> None:
        self._load = load
        self.sent = 0
        self.sink = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sink.bind((LOOPBACK, 0))
        try:
            self.sink.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _SINK_BUFFER_BYTES)
        except PermissionError:
            self.sink.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SINK_BUFFER_BYTES)
        buffer_bytes = self.sink.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        self.sink_holds = buffer_bytes // _KERNEL_BYTES
        """Number of datagrams that can wait at the sink."""
        self.sink.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        timeout = struct.pack("@ll", 0, round(_PING_TIMEOUT_S * 1e6))
        self.sink.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)
        self.out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    @property
    def sink_port(self) -> int:
        """The port on loopback to which the relay sends."""
        return int(self.sink.getsockname()[1])

    def connect(self, port: int) -> None:
        """Send to this port on loopback from now on."""
        self.out.connect((LOOPBACK, port))

    def close(self) -> None:
        """Close both sockets."""
        self.out.close()
        self.sink.close()

    def burst(
        self,
        relay: int,
        count: int,
        slack: int = 0,
        addresses: npt.NDArray[np.uint32] | None = None,
    ) -> Burst:
        """Stop the relay, fill its receive buffer, continue it, and wait until the buffer is empty.

        Args:
            relay: process id of the relay, a child of this process.
            count: datagrams to send.
            slack: the burst may end although this number of last datagrams have not arrived.
            addresses: send from these in turn; see :func:`sources`.
        """
        found = _Burst()
        senders = (None, 0) if addresses is None else (addresses.ctypes.data, len(addresses))
        first = self._first(count)
        self._call(
            "burst", self.sink.fileno(), relay, first, count, DATAGRAM_BYTES, *senders,
            slack, _PATIENCE_NS, ctypes.byref(found),
        )  # fmt: skip
        return found.result()

    def direct(self, count: int) -> tuple[Burst, float]:
        """Send directly to the sink; also return the CPU time in seconds."""
        found, cpu_ns = _Burst(), ctypes.c_int64()
        self._call(
            "direct", self.sink.fileno(), self._first(count), count, DATAGRAM_BYTES, _PATIENCE_NS,
            ctypes.byref(found), ctypes.byref(cpu_ns),
        )  # fmt: skip
        return found.result(), cpu_ns.value * 1e-9

    def ping(self, count: int) -> Nanoseconds:
        """Return the one-way delays of datagrams sent one by one, ns; -1 for a missing one."""
        delays_ns = np.empty(count, np.int64)
        first = self._first(count)
        out = delays_ns.ctypes.data
        self._call("ping", self.sink.fileno(), first, count, DATAGRAM_BYTES, out)
        return delays_ns

    def pace(self, count: int, period_ns: int) -> Nanoseconds:
        """Return the one-way delays of datagrams sent every ``period_ns``, ns; -1: missing."""
        departures_ns, arrivals_ns = np.empty(count, np.int64), np.full(count, -1, np.int64)
        first = self._first(count)
        self._call("pace", first, count, DATAGRAM_BYTES, period_ns, departures_ns.ctypes.data)
        sink, out = self.sink.fileno(), arrivals_ns.ctypes.data
        self._load.load_collect(sink, first, count, _PATIENCE_NS, out)
        return np.where(arrivals_ns < 0, -1, arrivals_ns - departures_ns)

    def soak(self, state: Soak, groups: int, group: int, period_ns: int) -> None:
        """Send ``groups`` groups of ``group`` datagrams, one group every ``period_ns``."""
        sink = self.sink.fileno()
        self._call("soak", sink, groups, group, DATAGRAM_BYTES, period_ns, ctypes.byref(state))

    def _first(self, count: int) -> int:
        first, self.sent = self.sent, self.sent + count
        return first

    def _call(self, function: str, *arguments: object) -> None:
        number = getattr(self._load, f"load_{function}")(self.out.fileno(), *arguments)
        if number != 0:
            raise MeasurementError(f"{function}: {os.strerror(number)}")

"""Datagrams with a time of arrival on the monotonic clock that is never too early.

The kernel stamps a datagram with the real-time clock (SO_TIMESTAMPNS). Slewing changes the rate of
both clocks alike, so their difference changes only when the real-time clock is set (or the machine
is suspended). It is read before and after a datagram's arrival, as an interval, since two clocks
cannot be read at once. The smallest difference of these readings converts the stamp: the result is
late by the width of the interval, but not early, if the clock was set at most once between two
readings. If they show that it was set, the time of reading the datagram is used instead, as without
stamps.
"""

import socket
import struct
import sys
import time
from contextlib import suppress
from typing import NamedTuple

from noack.runtime.address import Address

_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY_BYTES = 64


class HostClocks:
    """The clocks of this host; tests replace them."""

    def monotonic_ns(self) -> int:
        """Return a reading of the monotonic clock."""
        return time.monotonic_ns()

    def realtime_ns(self) -> int:
        """Return a reading of the real-time clock."""
        return time.time_ns()

    def stamp_ns(self, stamp: bytes) -> int:
        """Return the time of a kernel's stamp on the real-time clock."""
        seconds, ns = _TIMESPEC.unpack_from(stamp)
        return int(seconds) * 10**9 + int(ns)


class ClockDifference(NamedTuple):
    """What readings of real-time minus monotonic clock say; each reading is an interval.

    While the real-time clock is not set, the difference is the same at all readings, and is from
    ``lower_ns`` to ``upper_ns``.
    """

    least_ns: int
    """The smallest lower end: no reading contains less."""
    lower_ns: int
    upper_ns: int

    @property
    def was_set(self) -> bool:
        """Whether no difference agrees with all readings."""
        return self.lower_ns > self.upper_ns

    def joined(self, other: "ClockDifference") -> "ClockDifference":
        """Return what the readings of both say."""
        return ClockDifference(
            min(self.least_ns, other.least_ns),
            max(self.lower_ns, other.lower_ns),
            min(self.upper_ns, other.upper_ns),
        )


def read_difference(clocks: HostClocks) -> ClockDifference:
    """Read the difference; readings are rounded down, hence 1 ns more on both sides."""
    before_ns = clocks.monotonic_ns()
    real_ns = clocks.realtime_ns()
    after_ns = clocks.monotonic_ns()
    lower_ns = real_ns - after_ns - 1
    return ClockDifference(lower_ns, lower_ns, real_ns + 1 - before_ns)


def latest_arrival_ns(stamp_ns: int, read_ns: int, difference: ClockDifference) -> int:
    """Return a monotonic time that is not before the arrival of a datagram.

    Args:
        stamp_ns: the kernel's stamp, real-time clock.
        read_ns: when the datagram was read, monotonic clock.
        difference: of the two clocks, read before and after the arrival.
    """
    return read_ns if difference.was_set else min(read_ns, stamp_ns + 1 - difference.least_ns)


class Arrival(NamedTuple):
    """A datagram, its source, and a time that is not before its arrival, monotonic clock."""

    data: bytes
    source: Address
    latest_ns: int


class ArrivalSocket:
    """Reads an own UDP socket without blocking; ``most_bytes`` is the longest valid datagram.

    A longer one is cut one byte above this.
    """

    def __init__(self, endpoint: socket.socket, most_bytes: int, clocks: HostClocks) -> None:
        self._endpoint = endpoint
        self._most_bytes = most_bytes
        self._clocks = clocks
        self._known: ClockDifference | None = None
        """Read since before the last call that left the socket empty: before any later arrival."""
        self.clock_sets = 0
        """Calls with datagrams for which the real-time clock was found to have been set."""
        self.errors = 0
        """ICMP errors of earlier sends."""
        endpoint.setblocking(False)
        if sys.platform == "linux":
            with suppress(OSError):
                endpoint.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def receive(self, most: int) -> list[Arrival]:
        """Return the datagrams that wait, at most ``most``."""
        before, known = read_difference(self._clocks), self._known
        self._known = known and known.joined(before)
        waiting: list[tuple[bytes, Address, int | None, int]] = []
        for _ in range(most):
            try:
                data, ancillary, _, source = self._endpoint.recvmsg(
                    self._most_bytes + 1, _ANCILLARY_BYTES
                )
            except BlockingIOError:
                self._known = before
                break
            except OSError:
                self.errors += 1
                continue
            read_ns = self._clocks.monotonic_ns()
            waiting.append((data, source[:2], self._stamp_ns(ancillary), read_ns))
        if not waiting:
            return []
        after = read_difference(self._clocks)
        self._known = self._known and self._known.joined(after)
        if known is None:  # nothing was read before these arrivals
            return [Arrival(data, source, read_ns) for data, source, _, read_ns in waiting]
        difference = known.joined(before).joined(after)
        self.clock_sets += difference.was_set
        return [
            Arrival(
                data,
                source,
                read_ns if stamp_ns is None else latest_arrival_ns(stamp_ns, read_ns, difference),
            )
            for data, source, stamp_ns, read_ns in waiting
        ]

    def _stamp_ns(self, ancillary: list[tuple[int, int, bytes]]) -> int | None:
        for level, kind, stamp in ancillary:
            is_stamp = (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS)
            if is_stamp and len(stamp) >= _TIMESPEC.size:
                return self._clocks.stamp_ns(stamp)
        return None

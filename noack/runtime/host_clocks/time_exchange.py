"""Exchanges of timestamps over UDP, from which a process bounds the offset of its clock.

The client sends a request and reads replies whenever it is polled; nothing waits. The reference
answers requests. Datagrams are authenticated. A reply is accepted once, and only for an outstanding
request. Whoever delays, repeats or drops datagrams can make the bound wider, but not wrong: a
request is received after it was sent, and a reply was sent before it is received.

Layout of a datagram, version 1, little endian. Request and reply have the same size, so that a
forged source address gains no traffic::

    offset  size  field
         0     2  magic, the bytes "NC"
         2     1  version, 1
         3     1  kind: 1 request, 2 reply
         4     4  reserved, 0
         8    16  nonce: random in a request, repeated in its reply
        24     8  number of the reference's clock; 0 in a request
        32     8  time of the request's arrival, ns of the reference's clock; 0 in a request
        40     8  time of sending the reply, ns of the same clock; 0 in a request
        48    16  tag: keyed BLAKE2b over all that precedes it

The magic bytes differ from those of the loop's datagrams, so that none passes for the other under
the same key. The own sending time is not in the datagram: the client keeps it.

A time of arrival is one on the monotonic clock that is never too early. The kernel stamps a
datagram with the real-time clock (SO_TIMESTAMPNS). Slewing changes the rate of both clocks alike,
so their difference changes only when the real-time clock is set (or the machine is suspended). It
is read before and after a datagram's arrival, as an interval, since two clocks cannot be read at
once. The smallest difference of these readings converts the stamp: the result is late by the width
of the interval, but not early, if the clock was set at most once between two readings. If they show
that it was set, the time of reading the datagram is used instead, as without stamps.
"""

import hmac
import secrets
import select
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import IntEnum
from typing import NamedTuple

from noack.core.errors import CallerError, why
from noack.protocol.wire_format import TAG_BYTES, TIMES_NS, Rejection, Tagger
from noack.runtime.address import Address, address_text, family_of
from noack.runtime.host_clocks.clock_offset import ClockOffset, Exchange, Restart

MAGIC = b"NC"
VERSION = 1
NONCE_BYTES = 16
_CONTENT = struct.Struct("<2sBBI16sQqq")
TIME_BYTES = _CONTENT.size + TAG_BYTES
_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY_BYTES = 64
PERIOD_NS = 20_000_000
"""Default of the shortest time between two requests."""
MOST_AT_ONCE = 64
"""Datagrams read in one call."""
_BURST = 2
"""Requests sent together: the first brings the code into the caches of both hosts, so that the time
between reading the clock and sending is several times shorter in the second."""
_MOST_OUTSTANDING = 64
"""Requests that wait for their answer; then the oldest is forgotten."""
_FLOOD_PAUSE_S = 0.01
"""After a full batch the answering thread pauses: it reads at most 6,400 datagrams a second."""
_STOP_CHECK_S = 0.2
"""Longest time until the answering thread sees that it should stop."""


class TimeKind(IntEnum):
    """Kinds of datagrams."""

    REQUEST = 1
    REPLY = 2


class TimeDatagram(NamedTuple):
    """The content of a datagram."""

    kind: TimeKind
    nonce: bytes
    clock: int = 0
    received_ns: int = 0
    sent_ns: int = 0


class TimeFormat:
    """Encodes and decodes datagrams under a key of 32 bytes."""

    def __init__(self, key: bytes) -> None:
        self._tag = Tagger(key)

    def encode(self, content: TimeDatagram) -> bytes:
        """Return the datagram."""
        kind, *fields = content
        packed = _CONTENT.pack(MAGIC, VERSION, kind, 0, *fields)
        return packed + self._tag(packed)

    def decode(self, datagram: bytes, kind: TimeKind) -> TimeDatagram | Rejection:
        """Return the content of a datagram of this kind, or why it is rejected."""
        if len(datagram) != TIME_BYTES:
            return Rejection.LENGTH
        magic, version, actual, reserved, nonce, clock, received_ns, sent_ns = _CONTENT.unpack_from(datagram)
        if magic != MAGIC or version != VERSION:
            return Rejection.VERSION
        if actual != kind:
            return Rejection.FLOW
        if not hmac.compare_digest(self._tag(datagram[:-TAG_BYTES]), datagram[-TAG_BYTES:]):
            return Rejection.TAG
        if reserved or not 0 <= received_ns <= sent_ns < TIMES_NS:
            return Rejection.RANGE
        return TimeDatagram(kind, nonce, clock, received_ns, sent_ns)


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
    """A bound from readings of real-time minus monotonic clock; each reading is an interval.

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
        difference: difference of the two clocks, read before and after the arrival.
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
        self._difference: ClockDifference | None = None
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
        earlier, previous = read_difference(self._clocks), self._difference
        self._difference = previous and previous.joined(earlier)
        waiting: list[tuple[bytes, Address, int | None, int]] = []
        for _ in range(most):
            try:
                data, ancillary, _, source = self._endpoint.recvmsg(self._most_bytes + 1, _ANCILLARY_BYTES)
            except BlockingIOError:
                self._difference = earlier
                break
            except OSError:
                self.errors += 1
                continue
            read_ns = self._clocks.monotonic_ns()
            waiting.append((data, source[:2], self._stamp_ns(ancillary), read_ns))
        if not waiting:
            return []
        later = read_difference(self._clocks)
        self._difference = self._difference and self._difference.joined(later)
        if previous is None:  # nothing was read before these arrivals
            return [Arrival(data, source, read_ns) for data, source, _, read_ns in waiting]
        difference = previous.joined(earlier).joined(later)
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


_HOST_CLOCKS = HostClocks()


def _open_socket(address: Address, use: Callable[[socket.socket, Address], None], verb: str) -> socket.socket:
    endpoint = socket.socket(family_of(address), socket.SOCK_DGRAM)
    try:
        use(endpoint, address)
    except OSError as error:
        endpoint.close()
        raise CallerError(f"cannot {verb} {address_text(address)}: {why(error)}") from None
    return endpoint


class TimeReference:
    """Answers requests with times of this host's monotonic clock.

    Its clock has a random number. A client that sees another number begins again. Raise CallerError
    if the address cannot be used.
    """

    def __init__(self, listen: Address, key: bytes) -> None:
        self._format = TimeFormat(key)
        self._endpoint = _open_socket(listen, socket.socket.bind, "listen on")
        self.address: Address = self._endpoint.getsockname()[:2]
        self._arrivals = ArrivalSocket(self._endpoint, TIME_BYTES, _HOST_CLOCKS)
        self._clock = secrets.randbits(64)
        self.answers_sent = 0
        self.rejected: Counter[Rejection] = Counter()
        self.send_errors: Counter[str] = Counter()

    def fileno(self) -> int:
        """Return the file descriptor to wait on."""
        return self._endpoint.fileno()

    def answer_all(self) -> int:
        """Answer the waiting requests, at most ``MOST_AT_ONCE``; return how many were read."""
        arrivals = self._arrivals.receive(MOST_AT_ONCE)
        for data, source, received_ns in arrivals:
            request = self._format.decode(data, TimeKind.REQUEST)
            if isinstance(request, Rejection):
                self.rejected[request] += 1
                continue
            sent_ns = _HOST_CLOCKS.monotonic_ns()
            reply = TimeDatagram(TimeKind.REPLY, request.nonce, self._clock, received_ns, sent_ns)
            try:
                self._endpoint.sendto(self._format.encode(reply), source)
                self.answers_sent += 1
            except OSError as error:
                self.send_errors[why(error)] += 1
        return len(arrivals)

    def close(self) -> None:
        """Close the socket."""
        self._endpoint.close()


@contextmanager
def answering(reference: TimeReference) -> Iterator[TimeReference]:
    """Answer on a thread meanwhile."""
    stop = threading.Event()

    def answer() -> None:
        while not stop.is_set():
            readable, _, _ = select.select([reference], (), (), _STOP_CHECK_S)
            if readable and reference.answer_all() == MOST_AT_ONCE:
                stop.wait(_FLOOD_PAUSE_S)

    thread = threading.Thread(target=answer, name="time reference", daemon=True)
    thread.start()
    try:
        yield reference
    finally:
        stop.set()
        thread.join()


class TimeClient:
    """Exchanges timestamps with a reference and enters them into ``offset``.

    Raise CallerError if the address cannot be used.
    """

    def __init__(
        self,
        reference: Address,
        key: bytes,
        offset: ClockOffset,
        *,
        period_ns: int = PERIOD_NS,
        clocks: HostClocks = _HOST_CLOCKS,
    ) -> None:
        self._format = TimeFormat(key)
        self._endpoint = _open_socket(reference, socket.socket.connect, "send to")
        self._arrivals = ArrivalSocket(self._endpoint, TIME_BYTES, clocks)
        self._clocks = clocks
        self._offset = offset
        self._period_ns = period_ns
        self._due_ns = clocks.monotonic_ns()
        self._outstanding: dict[bytes, int] = {}
        """Sending times of requests without a reply, by nonce, the oldest first."""
        self._clock: int | None = None
        self.sent = self.accepted = 0
        self.rejected: Counter[Rejection] = Counter()
        self.send_errors: Counter[str] = Counter()

    def fileno(self) -> int:
        """Return the file descriptor that is readable when a reply waits."""
        return self._endpoint.fileno()

    def poll(self) -> list[Restart]:
        """Read the waiting replies, at most ``MOST_AT_ONCE``, and send a request if one is due.

        Returns the restarts of the bound, if there are any.
        """
        restarts: list[Restart] = []
        for data, _, received_ns in self._arrivals.receive(MOST_AT_ONCE):
            reply = self._format.decode(data, TimeKind.REPLY)
            if isinstance(reply, Rejection):
                self.rejected[reply] += 1
            elif (sent_ns := self._outstanding.pop(reply.nonce, None)) is None:
                self.rejected[Rejection.STALE] += 1
            else:
                restarts += self._accept(reply, sent_ns, received_ns)
        if self._clocks.monotonic_ns() >= self._due_ns:
            self._due_ns = max(self._due_ns + self._period_ns, self._clocks.monotonic_ns())
            for _ in range(_BURST):
                self._send()
        return restarts

    def _accept(self, reply: TimeDatagram, sent_ns: int, received_ns: int) -> list[Restart]:
        if received_ns < sent_ns:  # the real-time clock was set, and set back
            received_ns = self._clocks.monotonic_ns()
        self.accepted += 1
        clock_restart = None
        if self._clock not in (None, reply.clock):
            clock_restart = self._offset.begin_again(received_ns)
        self._clock = reply.clock
        exchange = Exchange(sent_ns, reply.received_ns, reply.sent_ns, received_ns)
        return [restart for restart in (clock_restart, self._offset.add(exchange)) if restart is not None]

    def _send(self) -> None:
        nonce = secrets.token_bytes(NONCE_BYTES)
        request = self._format.encode(TimeDatagram(TimeKind.REQUEST, nonce))
        if len(self._outstanding) >= _MOST_OUTSTANDING:
            self._outstanding.pop(next(iter(self._outstanding)))
        sent_ns = self._clocks.monotonic_ns()
        try:
            self._endpoint.send(request)
            self._outstanding[nonce] = sent_ns
            self.sent += 1
        except OSError as error:
            self.send_errors[why(error)] += 1

    def close(self) -> None:
        """Close the socket."""
        self._endpoint.close()

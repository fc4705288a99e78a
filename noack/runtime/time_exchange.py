"""Exchanges of timestamps over UDP, from which a process bounds the offset of its clock.

The client sends a request and reads replies whenever it is polled; nothing waits. The reference
answers requests. Datagrams are authenticated (:mod:`noack.protocol.time_format`). A reply is
accepted once, and only for an outstanding request. Whoever delays, repeats or drops datagrams can
make the bound wider, but not wrong: a request is received after it was sent, and a reply was sent
before it is received.
"""

import secrets
import select
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from noack.core.clock_offset import ClockOffset, Exchange, Restart
from noack.core.errors import CallerError, why
from noack.protocol.time_format import (
    NONCE_BYTES,
    TIME_BYTES,
    TimeDatagram,
    TimeFormat,
    TimeKind,
)
from noack.protocol.wire_format import Rejection
from noack.runtime.address import Address, family_of, text_of
from noack.runtime.arrival_times import ArrivalSocket, HostClocks

PERIOD_NS = 20_000_000
"""Default of the shortest time between two requests."""
MOST_AT_ONCE = 64
"""Datagrams read in one call."""
_BURST = 2
"""Requests sent together: the first brings the code into the caches of both hosts, so that the time
between reading the clock and sending is several times shorter in the second."""
_MOST_OUTSTANDING = 64
_FLOOD_PAUSE_S = 0.01
"""After a full batch the answering thread pauses: it reads at most 6,400 datagrams a second."""
_STOP_CHECK_S = 0.2

_HOST_CLOCKS = HostClocks()


class TimeReference:
    """Answers requests with times of this host's monotonic clock.

    Its clock has a random number. A client that sees another number begins again.

    Raises:
        CallerError: the address cannot be used.
    """

    def __init__(self, listen: Address, key: bytes, clocks: HostClocks = _HOST_CLOCKS) -> None:
        self._format = TimeFormat(key)
        self._endpoint = socket.socket(family_of(listen), socket.SOCK_DGRAM)
        try:
            self._endpoint.bind(listen)
        except OSError as error:
            self._endpoint.close()
            raise CallerError(f"cannot listen on {text_of(listen)}: {why(error)}") from None
        self.address: Address = self._endpoint.getsockname()[:2]
        self._arrivals = ArrivalSocket(self._endpoint, TIME_BYTES, clocks)
        self._clocks = clocks
        self._clock = secrets.randbits(64)
        self.answered = 0
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
            sent_ns = self._clocks.monotonic_ns()
            reply = TimeDatagram(TimeKind.REPLY, request.nonce, self._clock, received_ns, sent_ns)
            try:
                self._endpoint.sendto(self._format.encode(reply), source)
                self.answered += 1
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

    Raises:
        CallerError: the address cannot be used.
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
        self._endpoint = socket.socket(family_of(reference), socket.SOCK_DGRAM)
        try:
            self._endpoint.connect(reference)
        except OSError as error:
            self._endpoint.close()
            raise CallerError(f"cannot send to {text_of(reference)}: {why(error)}") from None
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
        other = None
        if self._clock not in (None, reply.clock):
            other = self._offset.begin_again(received_ns)
        self._clock = reply.clock
        exchange = Exchange(sent_ns, reply.received_ns, reply.sent_ns, received_ns)
        return [one for one in (other, self._offset.add(exchange)) if one is not None]

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

"""UDP sockets: bound to one address, with large kernel buffers, never blocking."""

import errno
import select
import socket
import struct
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Generic, TypeVar

from noack.core.errors import CallerError
from noack.protocol.fleet import FleetDecoder
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.wire_format import MAX_DATAGRAM_BYTES, Decoder, Encoder, Flow, Message, flow_of
from noack.runtime.address import LOOPBACK, Address, family_of, text_of
from noack.runtime.peer_sockets import FloodWatch, SourceCount, enlarge_buffer, open_beside

_UNKNOWN_BYTES = 128 * 1024
"""Receive buffer for datagrams from unknown sources; the kernel doubles it. It holds about 300
datagrams, as many as are read between two turns of housekeeping."""
_UNKNOWN_READ_AT_END = 4096
"""Datagrams of that buffer read at the end: all of them, unless the flood goes on."""
_SO_MEMINFO = 55
_MEMINFO_WORDS = 9
_MEMINFO_WAITING_BYTES, _MEMINFO_DROPS = 0, 8
_LEAST_WAITING_BYTES = 512
"""The kernel needs at least so much memory for a datagram that waits, with its own data."""
_READ_AT_ONCE = 8  # datagrams read before the next look at deadlines: about 50 µs
SHED = "shed"
"""Rejection reason of datagrams from unknown sources that the kernel dropped in a flood."""
MAX_UDP_BYTES = 65_535

T = TypeVar("T")


def bind(port: int, key: str, host: str = LOOPBACK) -> socket.socket:
    """Return a non-blocking UDP socket, bound to an address and a port (0: any free one).

    Raise CallerError, which names the setting ``key``, if the port is taken or not permitted.
    """
    endpoint = socket.socket(family_of((host, port)), socket.SOCK_DGRAM)
    try:
        endpoint.bind((host, port))
    except OSError as error:
        endpoint.close()
        reason = {
            errno.EADDRINUSE: "is already taken by another program",
            errno.EACCES: "needs privileges that this user does not have",
        }.get(error.errno or 0, f"cannot be bound ({error.strerror})")
        raise CallerError(
            f"UDP port {text_of((host, port))} {reason}; set {key} to another port, or to 0 for any"
        ) from None
    endpoint.setblocking(False)
    enlarge_buffer(endpoint)
    return endpoint


def drops_of(endpoint: socket.socket) -> int | None:
    """Datagrams that the kernel dropped at a socket; None if the system has no such counter.

    This counter is always exact and costs nothing per datagram. The one that arrives with
    datagrams (SO_RXQ_OVFL) is exact only after the next datagram.
    """
    return _memory_information(endpoint, _MEMINFO_DROPS)


def most_waiting(endpoint: socket.socket) -> int | None:
    """Upper bound of the datagrams that wait at a socket; None if the system cannot tell."""
    waiting_bytes = _memory_information(endpoint, _MEMINFO_WAITING_BYTES)
    return None if waiting_bytes is None else waiting_bytes // _LEAST_WAITING_BYTES


def _memory_information(endpoint: socket.socket, word: int) -> int | None:
    try:
        found = endpoint.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * _MEMINFO_WORDS)
    except OSError:
        return None
    words = struct.unpack(f"={len(found) // 4}I", found[: len(found) // 4 * 4])
    return words[word] if len(words) > word else None


class CountingSocket(ABC, Generic[T]):
    """A bound socket (from :func:`bind`) with one destination, and counters.

    The sending socket stays unconnected: on a connected one, an ICMP error of an earlier datagram
    would fail the next send, which in the emulator is an unintended loss. Datagrams from other
    sources than the peers have a queue of their own (:mod:`noack.runtime.peer_sockets`).
    """

    def __init__(
        self, endpoint: socket.socket, destination: Address, peers: Sequence[Address]
    ) -> None:
        self._endpoint = endpoint
        self._destination = destination
        self._peers = frozenset(peers)
        self._beside = open_beside(endpoint, peers)
        self._unknown_fd: int | None = None
        if self._beside:
            self._unknown_fd = endpoint.fileno()
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UNKNOWN_BYTES)
        self._sockets = {one.fileno(): one for one in (*self._beside, endpoint)}
        self._source_of = {
            one.fileno(): peer
            for one, peer in zip(self._beside, dict.fromkeys(peers), strict=False)
            if not select.select([one], (), (), 0)[0]
        }
        """Peers, by sockets that were empty when already connected: no other source is in them."""
        self._everyone = list(self._sockets)
        self._only_peers = [one.fileno() for one in self._beside]
        self._flood = FloodWatch()
        self._sources = SourceCount(peers)
        self._sent = 0
        self.send_errors: Counter[str] = Counter()
        # First the datagrams that arrived before the peer sockets: they may be the peers'.
        self.watched: Sequence[int] = self._everyone[::-1]
        """File descriptors to wait on now, the most important first."""

    @abstractmethod
    def judge(self, data: bytes, source: Address) -> T | None:
        """Return the message of a datagram; None, counted as rejected, if it has none.

        ``data`` is cut at :attr:`most_bytes`.
        """

    most_bytes = MAX_DATAGRAM_BYTES + 1
    """A longer datagram is cut, and rejected by its length."""

    def receive(self, readable: int) -> T | None:
        """Return the next message from a readable file descriptor.

        A few rejected datagrams before it are skipped; None if the next few have no message.
        """
        endpoint, unknown = self._sockets[readable], readable == self._unknown_fd
        peer = self._source_of.get(readable)
        for _ in range(_READ_AT_ONCE):
            try:
                if peer is None:
                    data, (host, port, *_) = endpoint.recvfrom(self.most_bytes)
                    source = host, port
                else:  # takes half the time
                    data, source = endpoint.recv(self.most_bytes), peer
            except OSError:  # empty, or an ICMP error of an earlier send
                return None
            self._sources.add(source)
            message = self.judge(data, source)
            if unknown and source not in self._peers and self._spend():
                return message
            if message is not None:
                return message
        return None

    def _spend(self) -> bool:
        """Count a datagram from an unknown source; whether it was the last of this interval."""
        self._flood.left -= 1
        if self._flood.left > 0:
            return False
        self.watched = self._only_peers
        return True

    def put(self, data: bytes, destination: Address | None = None) -> None:
        """Send a datagram; a failure is counted."""
        try:
            self._endpoint.sendto(data, destination or self._destination)
            self._sent += 1
        except OSError as error:
            self.send_errors[str(error)] += 1

    def tend(self, now_ns: int) -> Sequence[Record | Notice]:
        """Begin the next interval of housekeeping; return log lines about the last one."""
        if self._unknown_fd is None:
            return ()
        line = self._flood.next_interval(self._shed())
        self.watched = self._everyone
        return () if line is None else (Notice(now_ns, "info", line),)

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        self._read_the_rest()
        receiving = self._beside or (self._endpoint,)
        drops = [drops_of(one) for one in receiving]
        return {
            "local": text_of(self._endpoint.getsockname()),
            "destination": text_of(self._destination),
            "sent": self._sent,
            "send_errors": dict(self.send_errors),
            "received_from": self._sources.report(),
            "peer_sockets": bool(self._beside),
            "lost_in_kernel": None if None in drops else sum(n for n in drops if n is not None),
        }

    def rejected(self, by_reason: Mapping[str, int]) -> dict[str, int]:
        """Add the datagrams from unknown sources that the kernel dropped in a flood."""
        shed = {SHED: self._shed()} if self._unknown_fd is not None else {}
        return {reason: n for reason, n in (*by_reason.items(), *shed.items()) if n}

    def close(self) -> None:
        """Close the sockets that it opened itself."""
        for one in self._beside:
            one.close()

    def _shed(self) -> int:
        return drops_of(self._endpoint) or 0

    def _read_the_rest(self) -> None:
        """Count the datagrams that still wait, so that the counters are complete."""
        if self._unknown_fd is None:
            return
        with suppress(OSError):
            for _ in range(_UNKNOWN_READ_AT_END):
                data, (host, port, *_) = self._endpoint.recvfrom(self.most_bytes)
                self._sources.add((host, port))
                self.judge(data, (host, port))


class MessageSocket(CountingSocket[Message]):
    """A process's socket in the loop: receives one flow and sends another (``sends``).

    Datagrams from other sources than the peer (``source``) are rejected. In the acknowledgement
    baseline it also receives acknowledgements, with a decoder from a sender, or sends them.
    """

    def __init__(
        self,
        endpoint: socket.socket,
        decoder: Decoder | FleetDecoder,
        encoder: Encoder,
        sends: Flow,
        *,
        source: Address,
        destination: Address,
        acknowledgements: tuple[Decoder | FleetDecoder, Address] | None = None,
        acknowledges_to: Address | None = None,
    ) -> None:
        peers = [source] if acknowledgements is None else [source, acknowledgements[1]]
        super().__init__(endpoint, destination, peers)
        self._decoder = decoder
        self._encoder = encoder
        self._sends = sends
        self._source = source
        self._acknowledgements = acknowledgements
        self._acknowledges_to = acknowledges_to

    def judge(self, data: bytes, source: Address) -> Message | None:
        """Decode a datagram; see :class:`noack.protocol.wire_format.Decoder`."""
        if self._acknowledgements is not None and flow_of(data) == Flow.ACKNOWLEDGEMENT:
            decoder, peer = self._acknowledgements
            return decoder.decode(data, from_peer=source == peer)
        return self._decoder.decode(data, from_peer=source == self._source)

    def send(self, message: Message) -> None:
        """Send a message."""
        if message.flow is Flow.ACKNOWLEDGEMENT and self._acknowledges_to is not None:
            self.put(self._encoder.encode(message), self._acknowledges_to)
            return
        if message.flow is not self._sends:
            raise ValueError(f"this process sends {self._sends.name}, not {message.flow.name}")
        self.put(self._encoder.encode(message))

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        report = super().report() | {"sends": self._sends.name.lower()}
        rejected = {reason.value: n for reason, n in self._decoder.rejected.items()}
        report |= {"accepted": self._decoder.accepted, "rejected": self.rejected(rejected)}
        if isinstance(self._decoder, FleetDecoder):
            report["loops"] = self._decoder.reports()
        if self._acknowledgements is not None:
            report["acknowledgements"] = self._acknowledgements[0].report()
        return report

"""UDP sockets: bound to one address, with large kernel buffers, never blocking."""

import errno
import os
import socket
import struct
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence

from noack.core.errors import CallerError, PeerError
from noack.protocol.machine_interface import Notice
from noack.protocol.wire_format import MAX_DATAGRAM_BYTES
from noack.runtime.address import LOOPBACK, Address, SocketName, family_of, text_of
from noack.runtime.peer_sockets import FloodWatch, SourceCount, enlarge_buffer, open_beside
from noack.runtime.real_time_loop import RecordSink

_UNKNOWN_BYTES = 128 * 1024
"""Receive buffer for datagrams from unknown sources; the kernel doubles it. It holds about 300
datagrams, as many as are read between two turns of housekeeping."""
_READ_AT_ONCE = 4096
"""Datagrams of that buffer read in one turn, and at the end: all, unless a flood goes on."""
_SO_MEMINFO = 55
_MEMINFO_WORDS = 9
_MEMINFO_DROPS = 8
SHED = "shed"
"""Rejection reason of datagrams from unknown sources that the kernel dropped in a flood."""
MAX_UDP_BYTES = 65_535


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
    try:
        found = endpoint.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * _MEMINFO_WORDS)
    except OSError:
        return None
    words = struct.unpack(f"={len(found) // 4}I", found[: len(found) // 4 * 4])
    return words[_MEMINFO_DROPS] if len(words) > _MEMINFO_DROPS else None


def errors_by_text(errors: Sequence[int]) -> dict[str, int]:
    """Return how many datagrams could not be sent, by the text of the error.

    Args:
        errors: numbers of datagrams by errno.
    """
    return {str(OSError(one, os.strerror(one))): n for one, n in enumerate(errors) if n}


class CountingSocket(ABC):
    """The sockets of a process in the loop, and what they count.

    The core reads the socket of each peer, and sends by sockets that are connected to the
    destinations. Python reads, at every turn of housekeeping, what other sources send to the
    process's port (:mod:`noack.runtime.peer_sockets`). At the first turn it passes on what the
    peers sent before their sockets were open.

    Args:
        endpoint: the process's socket, from :func:`bind`; it stays unconnected.
        destinations: where datagrams go, most of them to the first.
        peers: the addresses that datagrams are expected from.

    Raises:
        PeerError: the system refused a socket for a peer.
    """

    most_bytes = MAX_DATAGRAM_BYTES + 1
    """A longer datagram is cut, and rejected by its length."""

    def __init__(
        self, endpoint: socket.socket, destinations: Sequence[Address], peers: Sequence[Address]
    ) -> None:
        self._destination, self._peers = destinations[0], frozenset(peers)
        others = [address for address in dict.fromkeys(destinations) if address not in peers]
        opened = open_beside(endpoint, [*peers, *others])
        if not opened:
            raise PeerError("the system refused to open a socket for each peer")
        self._opened = dict(zip([*dict.fromkeys(peers), *others], opened, strict=True))
        self.peer_sockets = [self._opened[address] for address in dict.fromkeys(peers)]
        self.senders = [self._opened[address] for address in destinations]
        """Sockets connected to the destinations."""
        self._unexpected = [endpoint, *(self._opened[address] for address in others)]
        for unexpected in self._unexpected:
            unexpected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UNKNOWN_BYTES)
        self._flood, self._sources = FloodWatch(), SourceCount(peers)
        self._counted: Counter[Address] = Counter()
        self._begins = True

    @abstractmethod
    def take(self, data: bytes, source: SocketName, now_ns: int, sink: RecordSink) -> None:
        """Process a datagram that Python has received; it is cut at :attr:`most_bytes`."""

    def tend(self, now_ns: int, sink: RecordSink) -> None:
        """Begin the next interval of housekeeping; read the datagrams of other sources."""
        line = self._flood.next_interval(self._shed())
        if line is not None:
            sink.notice(Notice(now_ns, "info", line))
        left = _READ_AT_ONCE
        while (left or self._begins) and self._flood.left > 0:
            if not self._read(now_ns, sink):
                break
            left = max(left - 1, 0)
        self._begins = False

    def _read(self, now_ns: int, sink: RecordSink) -> bool:
        """Read a datagram from a source that is no peer; return whether there was one."""
        for endpoint in self._unexpected:
            try:
                data, source = endpoint.recvfrom(self.most_bytes)
            except BlockingIOError:
                continue
            except OSError:  # an ICMP error of an earlier datagram
                return True
            self._take(data, source, now_ns, sink)
            return True
        return False

    def _take(self, data: bytes, source: SocketName, now_ns: int, sink: RecordSink) -> None:
        address = source[:2]
        self._sources.add(address)
        if address not in self._peers:
            self._flood.left -= 1
        self.take(data, source, now_ns, sink)

    def count_received(self, source: Address, total: int) -> None:
        """Note how many datagrams the core has received from a peer so far."""
        self._sources.add(source, total - self._counted[source])
        self._counted[source] = total

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        drops = [drops_of(one) for one in self.peer_sockets]
        return {
            "local": text_of(self._unexpected[0].getsockname()),
            "destination": text_of(self._destination),
            "received_from": self._sources.report(),
            "lost_in_kernel": None if None in drops else sum(n for n in drops if n is not None),
        }

    def rejected(self, by_reason: Mapping[str, int]) -> dict[str, int]:
        """Add the datagrams from unknown sources that the kernel dropped in a flood."""
        return {reason: n for reason, n in (*by_reason.items(), (SHED, self._shed())) if n}

    def finish(self, now_ns: int, sink: RecordSink) -> None:
        """Read the datagrams that still wait, so that the counters are complete."""
        for _ in range(_READ_AT_ONCE):
            if not self._read(now_ns, sink):
                return

    def close(self) -> None:
        """Close the sockets that it opened itself."""
        for opened in self._opened.values():
            opened.close()

    def _shed(self) -> int:
        return sum(drops_of(endpoint) or 0 for endpoint in self._unexpected)

"""The UDP sockets of a process of a run: never blocking, one for each peer, with what they count.

Beside the process's socket there is one more per peer, on the same port and connected to the peer.
The kernel delivers each datagram to the best matching socket, so that datagrams from unknown
sources stay in the queue of the first socket. They can neither displace nor delay a peer's
datagram, and the kernel's drop counters are exact for each queue. :class:`FloodWatch` limits how
many datagrams from unknown sources are read.

A datagram with a peer's forged address passes; only root can send one on the same machine.
"""

import os
import socket
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager

from netem.core.address import LOOPBACK, Address, SocketName, address_text, family_of
from netem.core.errors import PeerError
from netem.core.number_format import counted
from netem.core.udp_sockets import bind_to, drops_of, enlarge_buffer
from noack.protocol.roles import Notice
from noack.protocol.wire_format import MAX_DATAGRAM_BYTES
from noack.runtime.drivers.real_time_loop import RecordSink

_UNKNOWN_BYTES = 128 * 1024
"""Receive buffer for datagrams from unknown sources; the kernel doubles it. It holds about 300
datagrams, as many as are read between two turns of housekeeping."""
_READ_AT_ONCE = 4096
"""Datagrams of that buffer read in one turn, and at the end: all, unless a flood goes on."""
DROPPED_IN_FLOOD = "shed"
"""Rejection reason of datagrams from unknown sources that the kernel dropped in a flood."""
READ_PER_INTERVAL = 256
"""Datagrams from unknown sources read between two turns of housekeeping, 50 ms: about 5,000 a
second, which takes a twentieth of a core."""
READ_PER_INTERVAL_IN_FLOOD = 16
"""The same in a flood, of which the sources and the end must be seen."""
_CALM_INTERVALS = 20
_MOST_CALM_INTERVALS = 1200
"""Intervals without a flood after which it is over: at first, and, as each flood doubles it, at most."""
_REPORTED_SOURCES = 16
_KNOWN_SOURCES = 256
"""Unknown sources that a report names, and that are counted one by one."""


def bind(port: int, key: str, host: str = LOOPBACK) -> socket.socket:
    """Return a non-blocking UDP socket, bound to an address and a port (0: any free one).

    Raise CallerError, which names the setting ``key``, if the port is taken or not permitted.
    """
    address = host, port
    endpoint = socket.socket(family_of(address), socket.SOCK_DGRAM)
    title, remedy = f"UDP port {address_text(address)}", f"set {key} to another port, or to 0 for any"
    bind_to(endpoint, address, title, remedy)
    endpoint.setblocking(False)
    enlarge_buffer(endpoint)
    return endpoint


def errors_by_text(errors: Sequence[int]) -> dict[str, int]:
    """Return how many datagrams could not be sent, by the text of the error.

    Args:
        errors: numbers of datagrams by errno.
    """
    return {str(OSError(number, os.strerror(number))): n for number, n in enumerate(errors) if n}


class CountingSockets(ABC):
    """The sockets of a process in the loop, and what they count.

    The core reads the socket of each peer, and sends by sockets that are connected to the
    destinations. Python reads, at every turn of housekeeping, what other sources send to the
    process's port, as far as :class:`FloodWatch` allows. At the first turn it passes on what the
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
        other_destinations = [address for address in dict.fromkeys(destinations) if address not in peers]
        sockets = open_beside(endpoint, [*peers, *other_destinations])
        if not sockets:
            raise PeerError("the system refused to open a socket for each peer")
        self._sockets = dict(zip([*dict.fromkeys(peers), *other_destinations], sockets, strict=True))
        self.peer_sockets = [self._sockets[address] for address in dict.fromkeys(peers)]
        self.senders = [self._sockets[address] for address in destinations]
        """Sockets connected to the destinations."""
        self._unexpected = [endpoint, *(self._sockets[address] for address in other_destinations)]
        for unexpected in self._unexpected:
            unexpected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UNKNOWN_BYTES)
        self._flood, self._sources = FloodWatch(), SourceCount(peers)
        self._core_totals: Counter[Address] = Counter()
        self._is_first_turn = True

    @abstractmethod
    def take(self, data: bytes, source: SocketName, now_ns: int, sink: RecordSink) -> None:
        """Process a datagram that Python has received; it is cut at :attr:`most_bytes`."""

    def do_housekeeping(self, now_ns: int, sink: RecordSink) -> None:
        """Begin the next interval of housekeeping; read the datagrams of other sources."""
        line = self._flood.next_interval(self._flood_drops())
        if line is not None:
            sink.notice(Notice(now_ns, "info", line))
        reads_left = _READ_AT_ONCE
        while (reads_left or self._is_first_turn) and self._flood.reads_left > 0:
            if not self._read(now_ns, sink):
                break
            reads_left = max(reads_left - 1, 0)
        self._is_first_turn = False

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
            self._flood.reads_left -= 1
        self.take(data, source, now_ns, sink)

    def count_received(self, source: Address, total: int) -> None:
        """Note how many datagrams the core has received from a peer so far."""
        self._sources.add(source, total - self._core_totals[source])
        self._core_totals[source] = total

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary.

        A drop of the kernel is one datagram, or up to 64 that the peer sent together, each for
        another loop.
        """
        drops = [drops_of(endpoint) for endpoint in self.peer_sockets]
        return {
            "local": address_text(self._unexpected[0].getsockname()),
            "destination": address_text(self._destination),
            "received_from": self._sources.report(),
            "kernel_drops": None if None in drops else sum(n for n in drops if n is not None),
        }

    def rejected(self, by_reason: Mapping[str, int]) -> dict[str, int]:
        """Add the datagrams from unknown sources that the kernel dropped in a flood."""
        return {reason: n for reason, n in (*by_reason.items(), (DROPPED_IN_FLOOD, self._flood_drops())) if n}

    def finish(self, now_ns: int, sink: RecordSink) -> None:
        """Read the datagrams that still wait, so that the counters are complete."""
        for _ in range(_READ_AT_ONCE):
            if not self._read(now_ns, sink):
                return

    def close(self) -> None:
        """Close the sockets that it opened itself."""
        for endpoint in self._sockets.values():
            endpoint.close()

    def _flood_drops(self) -> int:
        return sum(drops_of(endpoint) or 0 for endpoint in self._unexpected)


def open_beside(endpoint: socket.socket, peers: Iterable[Address]) -> tuple[socket.socket, ...]:
    """Open a socket for each peer on the address of ``endpoint``, connected to the peer.

    ``endpoint`` is a bound UDP socket; it still receives from all other sources. The sockets do not
    block, have receive buffers of its size and the order of the peers. There are none if the system
    refuses them.
    """
    size_bytes = endpoint.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    with ExitStack() as undo:
        sockets = []
        try:
            with _shared(endpoint):
                for peer in dict.fromkeys(peers):
                    peer_socket = undo.enter_context(socket.socket(endpoint.family, socket.SOCK_DGRAM))
                    peer_socket.setblocking(False)
                    # Before it receives: a stall of a few milliseconds fills the default buffer.
                    enlarge_buffer(peer_socket, size_bytes)
                    peer_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
                    peer_socket.bind(endpoint.getsockname())
                    peer_socket.connect(peer)
                    sockets.append(peer_socket)
            for peer_socket in sockets:
                peer_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)
        except OSError:
            return ()
        undo.pop_all()
    return tuple(sockets)


@contextmanager
def _shared(endpoint: socket.socket) -> Iterator[None]:
    """Let this user bind the port again for a moment; permanently, any of his programs could."""
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    try:
        yield
    finally:
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)


class FloodWatch:
    """Limits how many datagrams from unknown sources are read, and detects floods.

    A flood begins with an interval in which more arrive than are read. It ends after a number of
    consecutive calm intervals. This number doubles with each flood, so that repeated floods do not
    fill the log.
    """

    def __init__(self) -> None:
        self.reads_left = READ_PER_INTERVAL
        """Number of those that may still be read in this interval; the reader decrements it."""
        self.is_flood = False
        self._allowed = READ_PER_INTERVAL
        self._dropped = 0
        self._drops_at_start = 0
        self._calm_intervals = 0
        self._needed_calm_intervals = _CALM_INTERVALS

    def next_interval(self, dropped: int) -> str | None:
        """Begin the next interval; return a log line about the last one, if there is any.

        ``dropped`` is the number of datagrams that the kernel has dropped so far.
        """
        earlier, self._dropped = self._dropped, dropped
        arrived = self._allowed - self.reads_left + dropped - earlier
        too_many = arrived > READ_PER_INTERVAL if self.is_flood else dropped > earlier or self.reads_left == 0
        line = None
        if self.is_flood:
            self._calm_intervals = 0 if too_many else self._calm_intervals + 1
            if self._calm_intervals >= self._needed_calm_intervals:
                line = self._end()
        elif too_many:
            line = self._begin(earlier)
        self.reads_left = self._allowed = READ_PER_INTERVAL_IN_FLOOD if self.is_flood else READ_PER_INTERVAL
        return line

    def _begin(self, dropped_before: int) -> str:
        self.is_flood, self._calm_intervals = True, 0
        self._drops_at_start = dropped_before
        return (
            "flood: too many datagrams from unknown sources; "
            "the kernel drops them and keeps the peers' datagrams"
        )

    def _end(self) -> str:
        self.is_flood = False
        self._needed_calm_intervals = min(2 * self._needed_calm_intervals, _MOST_CALM_INTERVALS)
        drops = self._dropped - self._drops_at_start
        return f"the flood is over: the kernel dropped {counted(drops, 'datagram')} from unknown sources"


class SourceCount:
    """Counts datagrams by source address, cheaply while the source stays the same.

    Peers always have a count of their own; of the other sources only the most frequent have one.
    """

    def __init__(self, peers: Iterable[Address] = ()) -> None:
        self._peers = dict.fromkeys(peers, 0)
        self.others: Counter[Address] = Counter()
        """Datagrams of the other sources that are known at present."""
        self._unnamed_count = 0
        self._pending_source: Address | None = None
        self._pending_count = 0

    def add(self, source: Address, datagrams: int = 1) -> None:
        """Count datagrams."""
        if source == self._pending_source:
            self._pending_count += datagrams
            return
        self._fold()
        self._pending_source, self._pending_count = source, datagrams

    def add_others(self, datagrams: int) -> None:
        """Count datagrams of sources that are not named."""
        self._unnamed_count += datagrams

    def report(self) -> dict[str, int]:
        """Datagrams by source; the rare sources together are ``others``."""
        self._fold()
        self._forget(_REPORTED_SOURCES)
        sources = [*self._peers.items(), *self.others.most_common()]
        counts = {address_text(source): n for source, n in sources if n}
        return counts | ({"others": self._unnamed_count} if self._unnamed_count else {})

    def _fold(self) -> None:
        if self._pending_source is None:
            return
        if self._pending_source in self._peers:
            self._peers[self._pending_source] += self._pending_count
        else:
            self.others[self._pending_source] += self._pending_count
            if len(self.others) > _KNOWN_SOURCES:
                self._forget(_KNOWN_SOURCES // 2)
        self._pending_source, self._pending_count = None, 0

    def _forget(self, most: int) -> None:
        """Keep the ``most`` frequent sources: forged ones must not fill the memory."""
        frequent = Counter(dict(self.others.most_common(most)))
        self._unnamed_count += self.others.total() - frequent.total()
        self.others = frequent

"""Peer sockets: datagrams of each peer have a receive queue of their own in the kernel.

Beside the process's socket there is one more per peer, on the same port and connected to the peer.
The kernel delivers each datagram to the best matching socket, so that datagrams from unknown
sources stay in the queue of the first socket. They can neither displace nor delay a peer's
datagram, and the kernel's drop counters are exact for each queue. :class:`FloodWatch` limits how
many datagrams from unknown sources are read.

A datagram with a peer's forged address passes; only root can send one on the same machine.
"""

import socket
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from noack.runtime.address import Address, text_of

# The default receive buffer holds 256 small datagrams; 4 MiB hold about 10,000. A datagram lost by
# overflow is an unintended loss, which breaks the MANSD guarantee.
_BUFFER_BYTES = 4 * 1024 * 1024
_SO_RCVBUFFORCE = 33
IN_AN_INTERVAL = 256
"""Datagrams from unknown sources read between two turns of housekeeping, 50 ms: about 5,000 a
second, which takes a twentieth of a core."""
IN_A_FLOOD = 16  # datagrams of a flood that are read per interval, to see its sources and its end
_CALM_INTERVALS = 20
_MOST_CALM_INTERVALS = 1200
_REPORTED_SOURCES = 16
_KNOWN_SOURCES = 256


def enlarge_buffer(endpoint: socket.socket, size_bytes: int | None = None) -> int:
    """Request a receive buffer, by default of 4 MiB; return the size that the kernel set."""
    size_bytes = size_bytes or _BUFFER_BYTES
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, size_bytes)
    except OSError:
        with suppress(OSError):
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size_bytes)
    return endpoint.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def open_beside(endpoint: socket.socket, peers: Iterable[Address]) -> tuple[socket.socket, ...]:
    """Open a socket for each peer on the address of ``endpoint``, connected to the peer.

    ``endpoint`` is a bound UDP socket; it still receives from all other sources. The sockets do not
    block, have receive buffers of its size and the order of the peers. There are none if the system
    refuses them.
    """
    size_bytes = endpoint.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    with ExitStack() as undo:
        beside = []
        try:
            with _shared(endpoint):
                for peer in dict.fromkeys(peers):
                    one = undo.enter_context(socket.socket(endpoint.family, socket.SOCK_DGRAM))
                    one.setblocking(False)
                    # Before it receives: a stall of a few milliseconds fills the default buffer.
                    enlarge_buffer(one, size_bytes)
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
                    one.bind(endpoint.getsockname())
                    one.connect(peer)
                    beside.append(one)
            for one in beside:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)
        except OSError:
            return ()
        undo.pop_all()
    return tuple(beside)


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
        self.left = IN_AN_INTERVAL
        """How many may still be read in this interval; the reader decrements it."""
        self.is_flood = False
        self._allowed = IN_AN_INTERVAL
        self._dropped = 0
        self._begun_with = 0
        self._calm = 0
        self._needed = _CALM_INTERVALS

    def next_interval(self, dropped: int) -> str | None:
        """Begin the next interval; return a log line about the last one, if there is any.

        ``dropped`` is the number of datagrams that the kernel has dropped so far.
        """
        before, self._dropped = self._dropped, dropped
        came = self._allowed - self.left + dropped - before
        too_many = came > IN_AN_INTERVAL if self.is_flood else dropped > before or self.left == 0
        line = None
        if self.is_flood:
            self._calm = 0 if too_many else self._calm + 1
            if self._calm >= self._needed:
                line = self._end()
        elif too_many:
            line = self._begin(before)
        self.left = self._allowed = IN_A_FLOOD if self.is_flood else IN_AN_INTERVAL
        return line

    def _begin(self, dropped_before: int) -> str:
        self.is_flood, self._calm = True, 0
        self._begun_with = dropped_before
        return (
            "flood: too many datagrams from unknown sources; "
            "the kernel drops them and keeps the peers' datagrams"
        )

    def _end(self) -> str:
        self.is_flood = False
        self._needed = min(2 * self._needed, _MOST_CALM_INTERVALS)
        shed = self._dropped - self._begun_with
        return f"the flood is over: the kernel dropped {shed} datagrams from unknown sources"


class SourceCount:
    """Counts datagrams by source address, cheaply while the source stays the same.

    Peers always have a count of their own; of the other sources only the most frequent have one.
    """

    def __init__(self, peers: Iterable[Address] = ()) -> None:
        self._peers = dict.fromkeys(peers, 0)
        self._others: Counter[Address] = Counter()
        self._more = 0
        self._last: Address | None = None
        self._run = 0

    def add(self, source: Address, datagrams: int = 1) -> None:
        """Count datagrams."""
        if source == self._last:
            self._run += datagrams
            return
        self._fold()
        self._last, self._run = source, datagrams

    def add_others(self, datagrams: int) -> None:
        """Count datagrams of sources that are not named."""
        self._more += datagrams

    def report(self) -> dict[str, int]:
        """Datagrams by source; the rare sources together are ``others``."""
        self._fold()
        self._forget(_REPORTED_SOURCES)
        named = [*self._peers.items(), *self._others.most_common()]
        found = {text_of(source): n for source, n in named if n}
        return found | ({"others": self._more} if self._more else {})

    def _fold(self) -> None:
        if self._last is None:
            return
        if self._last in self._peers:
            self._peers[self._last] += self._run
        else:
            self._others[self._last] += self._run
            if len(self._others) > _KNOWN_SOURCES:
                self._forget(_KNOWN_SOURCES // 2)
        self._last, self._run = None, 0

    def _forget(self, most: int) -> None:
        """Keep the ``most`` frequent sources: forged ones must not fill the memory."""
        kept = Counter(dict(self._others.most_common(most)))
        self._more += self._others.total() - kept.total()
        self._others = kept

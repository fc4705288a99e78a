"""The shield: what comes from a process's peers has a queue of its own, in the kernel.

Beside the process's socket there is one more for each peer, on the same port and connected to the
peer. The kernel gives each datagram to the socket that fits best, so that what comes from elsewhere
stays with the first one, in a queue of its own. However much of it there is, it can neither push a
peer's datagram out nor stand in front of it, and the kernel's counts of what it dropped at one and
at the other are exact. No more of it is looked at than :class:`FloodWatch` allows.

A datagram with a peer's forged address passes, as it would anywhere; only an administrator of the
machine can send one. On other systems than Linux there is no shield.
"""

import socket
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager

from noack.runtime.address import Address

IN_AN_INTERVAL = 256
"""How many strangers' datagrams are looked at between two turns of housekeeping, 50 ms: some 5,000
a second, which takes a twentieth of a core."""
IN_A_FLOOD = 16
"""How many of a flood are looked at, to know what it is made of and when it ends."""
_CALM_INTERVALS = 20
_MOST_CALM_INTERVALS = 1200


def open_beside(endpoint: socket.socket, peers: Iterable[Address]) -> tuple[socket.socket, ...]:
    """Open a socket for each peer on the address of ``endpoint``, connected to the peer.

    Args:
        endpoint: a bound UDP socket; it goes on hearing everyone else.
        peers: whose datagrams are to be kept apart.

    Returns:
        The sockets, non-blocking, in the order of the peers; none if the system has no such thing.
    """
    if sys.platform != "linux":
        return ()
    with ExitStack() as undo:
        beside = []
        try:
            with _shared(endpoint):
                for peer in dict.fromkeys(peers):
                    one = undo.enter_context(socket.socket(endpoint.family, socket.SOCK_DGRAM))
                    one.setblocking(False)
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
    """Let this user bind the port again for a moment; for ever would let anything of his in."""
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    try:
        yield
    finally:
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)


class FloodWatch:
    """How many datagrams of strangers are looked at, and when their number is a flood.

    A flood begins with an interval in which more came than are looked at in one. It is over after
    enough intervals in a row in which fewer did; with each flood twice as many, so that floods
    without end do not make lines without end.
    """

    def __init__(self) -> None:
        self.left = IN_AN_INTERVAL
        """How many may still be looked at in this interval; whoever looks at one takes one off."""
        self.is_flood = False
        self._allowed = IN_AN_INTERVAL
        self._dropped = 0
        self._begun_with = 0
        self._calm = 0
        self._needed = _CALM_INTERVALS

    def next_interval(self, dropped: int) -> str | None:
        """Begin the next interval; return what is to be said of the one that ends, if anything.

        Args:
            dropped: how many the kernel has dropped so far, as nobody looked at them.
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
            "flood: more datagrams come from elsewhere than are looked at; "
            "the kernel drops the others, and keeps the peers' apart"
        )

    def _end(self) -> str:
        self.is_flood = False
        self._needed = min(2 * self._needed, _MOST_CALM_INTERVALS)
        shed = self._dropped - self._begun_with
        return f"the flood is over: the kernel has dropped {shed} datagrams from elsewhere"

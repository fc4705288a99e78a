"""Limits of connections before a request is parsed.

Every user of the machine can open connections to loopback, and leave them idle. A connection is a
stranger's until a request on it is admitted. There are at most some strangers: a further one takes
the place of the oldest, and each has some seconds. So file descriptors are left for the page, whose
own connections are not limited.
"""

import asyncio
from collections import OrderedDict

from uvicorn.protocols.http.auto import AutoHTTPProtocol

MOST_STRANGERS = 32
ADMITTED_WITHIN_S = 10.0

Peer = tuple[str, int]
"""The address of the other end: it tells open connections apart."""


class Strangers:
    """The connections without an admitted request, the oldest first."""

    def __init__(self) -> None:
        self._transports: OrderedDict[Peer, asyncio.Transport] = OrderedDict()

    def came(self, peer: Peer, transport: asyncio.Transport) -> None:
        """Count a new connection; abort the oldest if there are too many, or this one if it is slow."""
        self._transports.pop(peer, None)
        self._transports[peer] = transport
        if len(self._transports) > MOST_STRANGERS:
            self._transports.popitem(last=False)[1].abort()
        asyncio.get_running_loop().call_later(ADMITTED_WITHIN_S, self._expire, peer, transport)

    def forget(self, peer: Peer) -> None:
        """Count a connection no more: a request on it was admitted, or it was closed."""
        self._transports.pop(peer, None)

    def __len__(self) -> int:
        return len(self._transports)

    def _expire(self, peer: Peer, transport: asyncio.Transport) -> None:
        if self._transports.get(peer) is transport:
            self.forget(peer)
            transport.abort()


def limited_protocol(strangers: Strangers) -> type[asyncio.Protocol]:
    """Return the protocol of uvicorn with a limit of strangers."""

    class LimitedProtocol(AutoHTTPProtocol):  # type: ignore[misc, valid-type]  # one of two classes
        """A connection, which is a stranger's at first."""

        def connection_made(self, transport: asyncio.Transport) -> None:
            """Begin."""
            super().connection_made(transport)
            self._peer: Peer = transport.get_extra_info("peername") or ("", 0)
            strangers.came(self._peer, transport)

        def connection_lost(self, exc: Exception | None) -> None:
            """End."""
            strangers.forget(self._peer)
            super().connection_lost(exc)

    return LimitedProtocol

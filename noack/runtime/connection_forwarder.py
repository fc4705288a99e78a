"""Forwards the bytes of accepted connections to another socket, on a thread; with TLS or without.

With TLS, a connection must first send a proof of invitation. Those without one end before they
cost a handshake (:mod:`noack.runtime.connection_gate`), and never those with one. When too many
handshakes of connections with a proof are unfinished, the oldest one ends of the host that has the
most. When too many connections are forwarded, the newest ends of the host that has the most.
"""

import asyncio
import socket
import ssl
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass

from noack.protocol.invitation_proof import PROOF_BYTES, Answer, InvitationProof
from noack.runtime.connection_gate import FirstBytes, TaskLimit, accepting

_PROOF_S = 5.0
_HANDSHAKE_S = 5.0
_CLOSE_S = 5.0
_MOST_HANDSHAKES = 128
_MOST_CONNECTIONS = 64
_READ_BYTES = 1 << 16

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]
OpenTarget = Callable[[], Awaitable[Streams]]


@dataclass(frozen=True)
class Protection:
    """What accepted connections must have."""

    context: ssl.SSLContext
    proof: InvitationProof
    unserved: Callable[[Counter[str]], None] = lambda count: None
    """Called every second: how many connections without a proof ended since, by host."""


def forwarding(
    listening: socket.socket,
    target: OpenTarget,
    protection: Protection | None = None,
    *,
    linger_s: float = 0.0,
) -> AbstractContextManager[asyncio.AbstractEventLoop]:
    """Forward each connection to a new connection with the target, within the context.

    The context yields the event loop in which ``target`` is called.

    Args:
        listening: a socket that listens; the caller closes it.
        target: opens a connection.
        protection: what accepted connections must have; None: bytes pass as they are.
        linger_s: at the end, how long what was received may still be forwarded.
    """
    forwarder = _Forwarder(target, protection)
    first = None
    if protection is not None:
        proof, own = protection.proof, listening.getsockname()
        first = FirstBytes(
            judge=lambda data, other: proof.check(data, other, own),
            most=PROOF_BYTES,
            within_s=_PROOF_S,
            refused=Answer.REFUSED.value,
            no_room=Answer.NO_ROOM.value,
            unserved=protection.unserved,
        )
    return accepting(listening, forwarder.serve, first, name="forwarder", linger_s=linger_s)


class _Forwarder:
    """What happens to accepted connections."""

    def __init__(self, target: OpenTarget, protection: Protection | None) -> None:
        self._target, self._protection = target, protection
        self._handshakes = TaskLimit(_MOST_HANDSHAKES)
        self._connections = TaskLimit(_MOST_CONNECTIONS, end_newest=True)

    async def serve(self, accepted: socket.socket, _: bytes, host: str) -> None:
        """Forward a connection until one end closes it."""
        if self._protection is not None:
            accepted.send(Answer.ADMITTED.value)
        connection = socket.socket(fileno=accepted.detach())
        with self._handshakes.counted(host):
            reader, writer = await self._streams(connection)
        try:
            with self._connections.counted(host):
                await self._forward(reader, writer)
        finally:
            writer.transport.abort()

    async def _streams(self, connection: socket.socket) -> Streams:
        loop, reader = asyncio.get_running_loop(), asyncio.StreamReader()
        protocol = asyncio.StreamReaderProtocol(reader)
        context = None if self._protection is None else self._protection.context
        transport, _ = await loop.connect_accepted_socket(
            lambda: protocol,
            connection,
            ssl=context,
            ssl_handshake_timeout=None if context is None else _HANDSHAKE_S,
        )
        return reader, asyncio.StreamWriter(transport, protocol, reader, loop)

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Copy both directions until one ends; what was received by then is sent."""
        loop = asyncio.get_running_loop()
        inner_reader, inner_writer = await self._target()
        copies = [
            loop.create_task(_copy(reader, inner_writer)),
            loop.create_task(_copy(inner_reader, writer)),
        ]
        try:
            await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.gather(_close(inner_writer), _close(writer))
        finally:
            for copy in copies:
                copy.cancel()
            inner_writer.transport.abort()


async def _close(writer: asyncio.StreamWriter) -> None:
    """Close a connection when everything is sent; with TLS, once the other end has agreed."""
    with suppress(OSError):  # TimeoutError is one
        async with asyncio.timeout(_CLOSE_S):
            writer.close()
            await writer.wait_closed()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_READ_BYTES):
            writer.write(data)
            await writer.drain()

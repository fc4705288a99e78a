"""Forwards the bytes of accepted connections to another socket, on a thread; with TLS or without.

The newest connections have priority: when too many handshakes are unfinished, the oldest is ended.
So connections that stay half open keep nobody out. Without a valid certificate a connection gets
no byte further than the handshake.
"""

import asyncio
import socket
import ssl
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress

_HANDSHAKE_S = 5.0
_MOST_HANDSHAKES = 128
_MOST_CONNECTIONS = 64
_READ_BYTES = 1 << 16
_NO_DESCRIPTOR_PAUSE_S = 0.05

OpenTarget = Callable[[], Awaitable[tuple[asyncio.StreamReader, asyncio.StreamWriter]]]


@contextmanager
def forwarding(
    listening: socket.socket, target: OpenTarget, context: ssl.SSLContext | None = None
) -> Iterator[None]:
    """Forward each connection to a new connection with the target meanwhile.

    Args:
        listening: a socket that listens; the caller closes it.
        target: opens a connection.
        context: of the TLS that accepted connections must have; None: bytes pass as they are.
    """
    listening.setblocking(False)
    forwarder = _Forwarder(listening, target, context)
    thread = threading.Thread(target=forwarder.run, name="forwarder", daemon=True)
    thread.start()
    try:
        yield
    finally:
        forwarder.stop()
        thread.join()


class _Forwarder:
    """The event loop of the thread."""

    def __init__(
        self, listening: socket.socket, target: OpenTarget, context: ssl.SSLContext | None
    ) -> None:
        self._listening, self._target, self._context = listening, target, context
        self._loop = asyncio.new_event_loop()
        self._handshakes: dict[asyncio.Task[None], None] = {}
        """Connections whose handshake is not finished, the oldest first."""
        self._connections: set[asyncio.Task[None]] = set()

    def run(self) -> None:
        """Accept connections until :meth:`stop`."""
        asyncio.set_event_loop(self._loop)
        with suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._accept())
        left = asyncio.all_tasks(self._loop)
        for task in left:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        self._loop.run_until_complete(asyncio.sleep(0))  # aborted transports close now
        self._loop.close()

    def stop(self) -> None:
        """End :meth:`run`, from another thread."""

        def cancel() -> None:
            for task in asyncio.all_tasks(self._loop):
                task.cancel()

        self._loop.call_soon_threadsafe(cancel)

    async def _accept(self) -> None:
        while True:
            try:
                connection, _ = await self._loop.sock_accept(self._listening)
            except OSError:  # its other end has gone, or there are no descriptors left
                await asyncio.sleep(_NO_DESCRIPTOR_PAUSE_S)
                continue
            if len(self._handshakes) >= _MOST_HANDSHAKES:
                oldest = next(iter(self._handshakes))
                del self._handshakes[oldest]
                oldest.cancel()
            self._loop.create_task(self._serve(connection)).add_done_callback(self._forget)

    def _forget(self, task: asyncio.Task[None]) -> None:
        self._handshakes.pop(task, None)
        self._connections.discard(task)
        if not task.cancelled():
            task.exception()  # what failed concerns this connection only

    async def _serve(self, connection: socket.socket) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._handshakes[task] = None
        reader = asyncio.StreamReader()
        protocol = asyncio.StreamReaderProtocol(reader)
        transport, _ = await self._loop.connect_accepted_socket(
            lambda: protocol,
            connection,
            ssl=self._context,
            ssl_handshake_timeout=None if self._context is None else _HANDSHAKE_S,
        )
        self._handshakes.pop(task, None)
        writer = asyncio.StreamWriter(transport, protocol, reader, self._loop)
        try:
            if len(self._connections) < _MOST_CONNECTIONS:
                self._connections.add(task)
                await self._forward(reader, writer)
        finally:
            transport.abort()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Copy both directions until one ends."""
        inner_reader, inner_writer = await self._target()
        copies = [
            self._loop.create_task(_copy(reader, inner_writer)),
            self._loop.create_task(_copy(inner_reader, writer)),
        ]
        try:
            await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for copy in copies:
                copy.cancel()
            inner_writer.transport.abort()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_READ_BYTES):
            writer.write(data)
            await writer.drain()

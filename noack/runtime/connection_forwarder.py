"""Forwards the bytes of accepted connections to another socket, on a thread; with TLS or without.

When too many handshakes are unfinished, the oldest one is ended of the host that has the most. So
connections that stay half open keep nobody out, least of all other hosts. Without a valid
certificate a connection gets no byte further than the handshake. When there are too many
connections with one, the newest is ended of the host that has the most.
"""

import asyncio
import socket
import ssl
import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

_HANDSHAKE_S = 5.0
_MOST_HANDSHAKES = 128
_MOST_CONNECTIONS = 64
_MOST_AT_ONCE = 1024
"""Connections accepted before the accepted ones are served. In a flood most of them are ended
before they cost a handshake, so that the kernel's queue empties."""
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
        self._handshakes: dict[asyncio.Task[None], str] = {}
        """Hosts of the connections whose handshake is not finished, the oldest first."""
        self._connections: dict[asyncio.Task[None], str] = {}
        """Hosts of the connections that are forwarded, the oldest first."""

    def run(self) -> None:
        """Accept connections until :meth:`stop`."""
        asyncio.set_event_loop(self._loop)
        self._loop.add_reader(self._listening, self._accept)
        self._loop.run_forever()
        self._loop.remove_reader(self._listening)
        left = asyncio.all_tasks(self._loop)
        for task in left:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        self._loop.run_until_complete(asyncio.sleep(0))  # aborted transports close now
        self._loop.close()

    def stop(self) -> None:
        """End :meth:`run`, from another thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)

    def _accept(self) -> None:
        """Accept the waiting connections."""
        for _ in range(_MOST_AT_ONCE):
            try:
                connection, source = self._listening.accept()
            except BlockingIOError:
                return
            except OSError:  # its other end has gone, or there are no descriptors left
                self._loop.remove_reader(self._listening)
                self._loop.call_later(
                    _NO_DESCRIPTOR_PAUSE_S, self._loop.add_reader, self._listening, self._accept
                )
                return
            if len(self._handshakes) >= _MOST_HANDSHAKES:
                _end_one(self._handshakes, self._handshakes)
            task = self._loop.create_task(self._serve(connection, source[0]))
            self._handshakes[task] = source[0]
            # Closes the connection if the task ends before it begins.
            task.add_done_callback(partial(self._forget, connection))

    def _forget(self, accepted: socket.socket, task: asyncio.Task[None]) -> None:
        accepted.close()
        self._handshakes.pop(task, None)
        self._connections.pop(task, None)
        if not task.cancelled():
            task.exception()  # what failed concerns this connection only

    async def _serve(self, accepted: socket.socket, host: str) -> None:
        task = asyncio.current_task()
        assert task is not None
        connection = socket.socket(fileno=accepted.detach())
        connection.setblocking(False)
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
            self._connections[task] = host
            if len(self._connections) > _MOST_CONNECTIONS:
                _end_one(self._connections, reversed(self._connections))
            await self._forward(reader, writer)
        finally:
            transport.abort()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Copy both directions until one ends."""
        inner_reader, inner_writer = await self._target()
        inner_writer.transport.set_write_buffer_limits(0)  # at the end, nothing waits to be written
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


def _end_one(hosts: dict[asyncio.Task[None], str], order: Iterable[asyncio.Task[None]]) -> None:
    """End the first task in an order of those of the host that has the most; forget it."""
    crowd = Counter(hosts.values()).most_common(1)[0][0]
    first = next(task for task in order if hosts[task] == crowd)
    del hosts[first]
    first.cancel()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_READ_BYTES):
            writer.write(data)
            await writer.drain()

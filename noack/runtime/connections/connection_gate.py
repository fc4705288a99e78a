"""Accepts connections on a thread, and reads the first bytes of each before it costs more.

A connection whose first bytes are not complete has a descriptor and a few bytes, but no task, no
TLS and no thread. When too many wait, the oldest ones of the hosts that have the most are closed.
Before one ends, what has arrived of it is read: only a connection without progress ends.
"""

import asyncio
import socket
import threading
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

_MOST_WAITING = 512
"""Connections that may wait for their first bytes."""
_ROOM = _MOST_WAITING // 4
"""Number of connections that end when there are too many: choosing them together costs less."""
_MOST_AT_ONCE = 128
"""Connections accepted before others are served."""
_NO_DESCRIPTOR_PAUSE_S = 0.05
"""Pause when no file descriptor is left for a connection."""
_CHECK_S = 1.0
"""Time between two checks for connections whose first bytes are overdue."""

Begin = Callable[[socket.socket, bytes, str], Coroutine[Any, Any, None]]
"""Serves a connection, given its first bytes and the other end's host; it is closed afterwards."""


@dataclass(frozen=True)
class FirstBytes:
    """The first bytes that a connection must send before it is served."""

    accept: Callable[[bytes, Any], bool | None]
    """Given the bytes and the other end's address: whether it is served; None: more are needed."""
    most: int
    """More bytes are not read, and not waited for."""
    within_s: float
    refusal: bytes = b""
    """Sent before a connection ends whose bytes are wrong."""
    no_room: bytes = b""
    """Sent before a connection ends to make room."""
    report_unserved: Callable[[Counter[str]], None] = lambda counts: None
    """Called every second: how many connections ended since without being served, by host."""


@contextmanager
def accepting(
    listening: socket.socket,
    begin: Begin,
    first: FirstBytes | None = None,
    *,
    name: str,
    linger_s: float = 0.0,
    longest_wait_s: float | None = None,
) -> Iterator[asyncio.AbstractEventLoop]:
    """Accept connections on a thread within the context, and yield the thread's event loop.

    All connections end with the context.

    Args:
        listening: a socket that listens; the caller closes it.
        begin: serves a connection in a task of the thread's event loop.
        first: what a connection must send before; None: it is served at once.
        name: name of the thread.
        linger_s: at the end, how long connections that are served may go on.
        longest_wait_s: longest wait at the end for a task that computes; None: no limit.
    """
    listening.setblocking(False)
    loop = asyncio.new_event_loop()
    gate = _Gate(loop, listening, begin, first, linger_s)
    thread = threading.Thread(target=gate.run, name=name, daemon=True)
    thread.start()
    try:
        yield loop
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(longest_wait_s)


class TaskLimit:
    """Limits how many tasks serve connections at once: one of the host that has the most ends.

    Args:
        most: the largest number.
        end_newest: whether the newest of that host ends; otherwise the oldest.
    """

    def __init__(self, most: int, *, end_newest: bool = False) -> None:
        self._most, self._end_newest = most, end_newest
        self._hosts: dict[asyncio.Task[Any], str] = {}
        """Oldest first."""

    @contextmanager
    def count(self, host: str) -> Iterator[None]:
        """Count the current task within the context."""
        task = asyncio.current_task()
        assert task is not None
        self._hosts[task] = host
        if len(self._hosts) > self._most:
            self._end_one()
        try:
            yield
        finally:
            self._hosts.pop(task, None)

    def _end_one(self) -> None:
        busiest_host = Counter(self._hosts.values()).most_common(1)[0][0]
        order = reversed(self._hosts) if self._end_newest else iter(self._hosts)
        task = next(task for task in order if self._hosts[task] == busiest_host)
        del self._hosts[task]
        task.cancel()


@dataclass(slots=True, eq=False)
class _PartialConnection:
    """A connection whose first bytes are not complete."""

    connection: socket.socket
    source: Any
    host: str
    until_s: float
    data: bytes = b""


class _Gate:
    """The event loop of the thread."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        listening: socket.socket,
        begin: Begin,
        first: FirstBytes | None,
        linger_s: float,
    ) -> None:
        self._loop, self._listening, self._begin, self._first = loop, listening, begin, first
        self._linger_s = linger_s
        self._descriptor = listening.fileno()
        self._waiting: dict[int, _PartialConnection] = {}
        """By descriptor, the oldest first."""
        self._unserved: Counter[str] = Counter()
        self._ending = False

    def run(self) -> None:
        """Accept connections until the loop is stopped."""
        loop = self._loop
        asyncio.set_event_loop(loop)
        loop.add_reader(self._descriptor, self._accept)
        if self._first is not None:
            loop.call_later(_CHECK_S, self._check)
        loop.run_forever()
        self._ending = True
        loop.remove_reader(self._descriptor)
        for waiting in list(self._waiting.values()):
            self._end(waiting)
        unfinished = asyncio.all_tasks(loop)
        if unfinished and self._linger_s:
            loop.run_until_complete(asyncio.wait(unfinished, timeout=self._linger_s))
        for task in unfinished:
            task.cancel()
        loop.run_until_complete(asyncio.gather(*unfinished, return_exceptions=True))
        loop.run_until_complete(asyncio.sleep(0))  # aborted transports close now
        loop.close()

    def _accept(self) -> None:
        """Accept the connections that wait in the kernel."""
        for _ in range(_MOST_AT_ONCE):
            try:
                connection, source = self._listening.accept()
            except BlockingIOError:
                return
            except OSError:  # its other end has gone, or there are no descriptors left
                self._make_room()
                self._loop.remove_reader(self._descriptor)
                self._loop.call_later(_NO_DESCRIPTOR_PAUSE_S, self._resume)
                return
            host = source[0] if source else ""  # a Unix socket has no host
            if self._first is None:
                self._serve(connection, b"", host)
                continue
            waiting = _PartialConnection(connection, source, host, self._loop.time() + self._first.within_s)
            self._waiting[connection.fileno()] = waiting
            if not self._advance(waiting, self._first):
                self._loop.add_reader(connection.fileno(), self._advance, waiting, self._first)
            if len(self._waiting) > _MOST_WAITING:
                self._make_room()

    def _resume(self) -> None:
        if not self._ending:
            self._loop.add_reader(self._descriptor, self._accept)

    def _advance(self, waiting: _PartialConnection, first: FirstBytes) -> bool:
        """Read what has arrived; return whether the connection waits no longer."""
        try:
            data = waiting.connection.recv(first.most - len(waiting.data), socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            self._end(waiting)
            return True
        waiting.data += data
        served = first.accept(waiting.data, waiting.source)
        if served is None and len(waiting.data) < first.most:
            return False
        if served:
            self._forget(waiting)
            self._serve(waiting.connection, waiting.data, waiting.host)
        else:
            self._end(waiting, first.refusal)
        return True

    def _make_room(self) -> None:
        """End the oldest connections without progress, of the hosts that have the most."""
        newer: Counter[str] = Counter()
        order: list[tuple[int, int, _PartialConnection]] = []
        for age, waiting in enumerate(reversed(self._waiting.values())):
            order.append((newer[waiting.host], age, waiting))
            newer[waiting.host] += 1
        order.sort(key=lambda entry: entry[:2], reverse=True)
        for _, _, waiting in order[:_ROOM]:
            if self._first is not None and not self._advance(waiting, self._first):
                self._end(waiting, self._first.no_room)

    def _check(self) -> None:
        """End the connections that are too late, and report how many were not served."""
        assert self._first is not None
        now_s = self._loop.time()
        for waiting in list(self._waiting.values()):
            if waiting.until_s > now_s:
                break
            self._end(waiting)
        counts, self._unserved = self._unserved, Counter()
        self._first.report_unserved(counts)
        self._loop.call_later(_CHECK_S, self._check)

    def _end(self, waiting: _PartialConnection, answer: bytes = b"") -> None:
        """Close a connection that is not served."""
        self._unserved[waiting.host] += 1
        self._forget(waiting)
        with suppress(OSError):
            waiting.connection.send(answer, socket.MSG_DONTWAIT)
        waiting.connection.close()

    def _forget(self, waiting: _PartialConnection) -> None:
        self._loop.remove_reader(waiting.connection.fileno())
        del self._waiting[waiting.connection.fileno()]

    def _serve(self, connection: socket.socket, data: bytes, host: str) -> None:
        connection.setblocking(False)
        # The task closes what it is given; the callback, if the task ends before it begins.
        task = self._loop.create_task(self._begin(connection, data, host))
        task.add_done_callback(partial(_finish, connection))


def _finish(connection: socket.socket, task: asyncio.Task[None]) -> None:
    connection.close()
    if not task.cancelled():
        task.exception()  # what failed concerns this connection only

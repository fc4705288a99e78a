"""Serves metrics over HTTP, for Prometheus and other readers of OpenMetrics.

Each connection has a thread and a time limit. Of too many connections the oldest is closed, and the
end of the server closes all: no reader keeps another one, or a run, waiting. Metrics are computed
when they are read, for one reader at a time.
"""

import socket
import socketserver
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from noack.core.errors import CallerError, MachineError, why
from noack.runtime.address import Address, family_of, parse_address, text_of

if TYPE_CHECKING:
    from prometheus_client import Metric

OPTION = "--metrics"
_POLL_S = 0.2
"""Time within which the server notices that it should end."""
_CONNECTION_S = 5.0
"""Time limit of a connection: for the whole request and its answer."""
_MOST_CONNECTIONS = 16


def require_package() -> None:
    """Raise CallerError if the package of the metrics is not installed."""
    try:
        import prometheus_client  # noqa: F401
    except ImportError:
        raise CallerError(
            f"{OPTION} needs prometheus_client, which is not installed; pip install "
            "'noack[metrics]'"
        ) from None


class _Server(socketserver.ThreadingMixIn, WSGIServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, *arguments: Any) -> None:
        self._open: dict[socket.socket, threading.Timer] = {}
        """The connections, the oldest first, each with the timer that ends it."""
        self._lock = threading.Lock()
        super().__init__(*arguments)

    def server_bind(self) -> None:
        """Bind, without asking a name server for the name of the host."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]  # type: ignore[assignment]
        self.setup_environ()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection on a thread, for a limited time."""
        timer = threading.Timer(_CONNECTION_S, _end, (request,))
        timer.daemon = True
        with self._lock:
            if len(self._open) >= _MOST_CONNECTIONS:
                oldest = next(iter(self._open))
                self._open.pop(oldest).cancel()
                _end(oldest)
            self._open[request] = timer
        timer.start()
        super().process_request(request, client_address)

    def close_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            timer = self._open.pop(request, None)
        if timer is not None:
            timer.cancel()
        super().close_request(request)

    def server_close(self) -> None:
        """Stop listening, and end all connections."""
        super().server_close()
        with self._lock:
            for request in self._open:
                _end(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a reader that has left."""


def _end(connection: socket.socket) -> None:
    """End a connection, of which another thread reads or to which it writes."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Handler(WSGIRequestHandler):
    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002
        """Log nothing."""


@contextmanager
def metrics_server(where: str, collect: "Callable[[], Iterable[Metric]]") -> Iterator[Address]:
    """Serve metrics within the context, at every path; yield the address.

    Args:
        where: ``HOST:PORT``; without a host it is the loopback, port 0 is any free one.
        collect: returns the metrics; called in threads of the server, one at a time.

    Raises:
        CallerError: the address is wrong or in use, or prometheus_client is not installed.
        MachineError: the server cannot be started.
    """
    require_package()
    from prometheus_client import CollectorRegistry
    from prometheus_client.exposition import make_wsgi_app

    address = parse_address(where, OPTION)
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(collect))
    family = type("_Family", (_Server,), {"address_family": family_of(address)})
    try:
        server = family(address, _Handler)
    except (OSError, OverflowError) as error:
        reason = why(error) if isinstance(error, OSError) else str(error)
        kind = MachineError if isinstance(error, PermissionError) else CallerError
        raise kind(f"{OPTION} {text_of(address)}: {reason}") from None
    server.set_app(make_wsgi_app(registry))
    thread = threading.Thread(
        target=server.serve_forever, args=(_POLL_S,), name="metrics", daemon=True
    )
    thread.start()
    try:
        yield server.server_address[:2]
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Collector:
    """A collector of prometheus_client, which computes all metrics when they are read."""

    def __init__(self, collect: "Callable[[], Iterable[Metric]]") -> None:
        self._collect, self._lock = collect, threading.Lock()

    def collect(self) -> "Iterable[Metric]":
        """Return the metrics."""
        with self._lock:
            return list(self._collect())

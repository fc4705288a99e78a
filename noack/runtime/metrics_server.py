"""Serves metrics over HTTP, for Prometheus and other readers of OpenMetrics.

The server answers one request at a time in a thread of its own, so that many or slow readers cost
no more than one. Metrics are computed when they are read.
"""

import socketserver
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from noack.core.errors import CallerError, MachineError, why
from noack.runtime.address import Address, family_of, parse_address, text_of

if TYPE_CHECKING:
    from prometheus_client import Metric

OPTION = "--metrics"
_POLL_S = 0.2
"""Time within which the server notices that it should end."""
_PATIENCE_S = 2.0
"""Longest wait for the rest of a request, and for the reader of the answer."""


def require_package() -> None:
    """Raise CallerError if the package of the metrics is not installed."""
    try:
        import prometheus_client  # noqa: F401
    except ImportError:
        raise CallerError(
            f"{OPTION} needs prometheus_client, which is not installed; pip install "
            "'noack[metrics]'"
        ) from None


class _Server(WSGIServer):
    allow_reuse_address = True

    def server_bind(self) -> None:
        """Bind, without asking a name server for the name of the host."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]  # type: ignore[assignment]
        self.setup_environ()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a reader that has left."""


class _Handler(WSGIRequestHandler):
    timeout = _PATIENCE_S

    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002
        """Log nothing."""


@contextmanager
def metrics_server(where: str, collect: "Callable[[], Iterable[Metric]]") -> Iterator[Address]:
    """Serve metrics within the context, at every path; yield the address.

    Args:
        where: ``HOST:PORT``; without a host it is the loopback, port 0 is any free one.
        collect: returns the metrics; called in the server's thread.

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
        thread.join(_PATIENCE_S)


class _Collector:
    """A collector of prometheus_client, which computes all metrics when they are read."""

    def __init__(self, collect: "Callable[[], Iterable[Metric]]") -> None:
        self._collect = collect

    def collect(self) -> "Iterable[Metric]":
        """Return the metrics."""
        return self._collect()

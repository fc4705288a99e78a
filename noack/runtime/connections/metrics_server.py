"""Serves metrics over HTTP, for Prometheus and other readers of OpenMetrics.

One thread serves all readers: it waits for none of them, and computes one answer at a time. Reading
a request and sending its answer have a time limit each, and there is a limit of readers. So many or
slow readers keep neither others waiting nor the end. Metrics are computed when they are read.
"""

import asyncio
import http.client
import io
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from noack.core.errors import CallerError, MachineError, why
from noack.runtime.address import Address, address_text, family_of, parse_address
from noack.runtime.connections.connection_gate import FirstBytes, TaskLimit, accepting

if TYPE_CHECKING:
    from prometheus_client import Metric

OPTION = "--metrics"
_REQUEST_S = 5.0
"""Longest time for a request, from its connection on."""
_ANSWER_S = 5.0
"""Longest time for sending an answer."""
_MOST_REQUEST_BYTES = 16_384
"""A longer request is refused."""
_MOST_ANSWERS = 64
"""Answers that are sent at once; then the oldest ends of the host that has the most."""
_BACKLOG = 128
"""Connections that the kernel keeps until they are accepted."""
_END_S = 2.0
"""At the end: longest wait for an answer that is being computed."""
_WRONG = b"HTTP/1.0 400 Bad Request\r\n\r\n"
_BUSY = b"HTTP/1.0 503 Service Unavailable\r\n\r\n"


def require_package() -> None:
    """Raise CallerError if the package of the metrics is not installed."""
    try:
        import prometheus_client  # noqa: F401 - an optional package
    except ImportError:
        raise CallerError(
            f"{OPTION} needs prometheus_client, which is not installed; pip install 'noack[metrics]'"
        ) from None


@contextmanager
def metrics_server(host_port: str, collect: "Callable[[], Iterable[Metric]]") -> Iterator[Address]:
    """Serve metrics within the context, at every path; yield the address.

    Args:
        host_port: ``HOST:PORT``; without a host it is the loopback, port 0 is any free one.
        collect: returns the metrics; called in the server's thread.

    Raises:
        CallerError: the address is wrong or in use, or prometheus_client is not installed.
        MachineError: the server cannot be started.
    """
    require_package()
    from prometheus_client import CollectorRegistry  # an optional package
    from prometheus_client.exposition import make_wsgi_app  # an optional package

    address = parse_address(host_port, OPTION)
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(collect))
    app = make_wsgi_app(registry)
    limit = TaskLimit(_MOST_ANSWERS)

    async def answer(connection: socket.socket, request: bytes, host: str) -> None:
        with limit.count(host):
            content = _answer(app, request)
            async with asyncio.timeout(_ANSWER_S):
                await asyncio.get_running_loop().sock_sendall(connection, content)
            connection.shutdown(socket.SHUT_WR)

    first = FirstBytes(_is_complete, _MOST_REQUEST_BYTES, _REQUEST_S, _WRONG, _BUSY)
    with (
        _listening(address) as listening,
        accepting(listening, answer, first, name="metrics", longest_wait_s=_END_S),
    ):
        yield listening.getsockname()[:2]


@contextmanager
def _listening(address: Address) -> Iterator[socket.socket]:
    with socket.socket(family_of(address), socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(address)
            listening.listen(_BACKLOG)
        except (OSError, OverflowError) as error:
            reason = why(error) if isinstance(error, OSError) else str(error)
            kind = MachineError if isinstance(error, PermissionError) else CallerError
            raise kind(f"{OPTION} {address_text(address)}: {reason}") from None
        yield listening


def _is_complete(request: bytes, _: object) -> bool | None:
    """Whether a request is complete: up to the empty line after its headers."""
    return True if b"\n\r\n" in request or b"\n\n" in request else None


def _answer(app: Callable[..., Iterable[bytes]], request: bytes) -> bytes:
    """Return the answer of a WSGI application to a request."""
    line, _, header_lines = request.partition(b"\n")
    words = line.decode("latin-1").split()
    try:
        headers = http.client.parse_headers(io.BytesIO(header_lines))
        method, target, version = words
    except (ValueError, http.client.HTTPException):
        return _WRONG
    if not version.startswith("HTTP/"):
        return _WRONG
    path, _, query = target.partition("?")
    environment = {"REQUEST_METHOD": method, "PATH_INFO": path, "QUERY_STRING": query}
    for name in ("Accept", "Accept-Encoding"):
        environment[f"HTTP_{name.upper().replace('-', '_')}"] = headers.get(name, "")
    head: list[str] = []

    def start(status: str, fields: list[tuple[str, str]]) -> None:
        head.append(f"HTTP/1.0 {status}")
        head.extend(f"{name}: {value}" for name, value in fields)

    body = b"".join(app(environment, start))
    head.append(f"Content-Length: {len(body)}")
    return "\r\n".join([*head, "", ""]).encode("latin-1") + body


class _Collector:
    """A collector of prometheus_client, which computes all metrics when they are read."""

    def __init__(self, collect: "Callable[[], Iterable[Metric]]") -> None:
        self._collect = collect

    def collect(self) -> "Iterable[Metric]":
        """Return the metrics."""
        return self._collect()

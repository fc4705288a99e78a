"""HTTP for live control: on a Unix socket, and on a loopback port for those who have its token.

Each connection carries one request and has a thread of its own, so a client that stalls delays nobody
else. A connection has limits: bytes of its head and its body, time, and the number of connections. An
answer that reports a mistake is a line of JSON.

A loopback port can be reached by every user of this machine, and by web pages in a browser. So a request
needs the token; and it is refused if its ``Host`` is another name (a page whose name was rebound to
127.0.0.1), or if a page sent it (``Origin``).
"""

import hmac
import io
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from email.message import Message
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any

from netem.control.control_routes import Answer, ControlRoutes, error_answer
from netem.core.errors import printable, shortened
from netem.relay.relay_reports import report_line

LOOPBACK = "127.0.0.1"
HEAD_BYTES = 16 * 2**10
"""Largest head of a request, its first line and its headers."""
BODY_BYTES = 4 * 2**20
"""Largest body of a request: settings with a table of some 300,000 numbers."""
CONNECTIONS = 64
"""Largest number of connections of a server."""
_REQUEST_S = 10.0
"""Longest time in which a request arrives."""
_ANSWER_S = 10.0
"""Longest time in which a client takes its answer."""
_REST_S = 1.0
"""Longest pause in the rest of a refused request: it is read, because closing the socket before would
reset the connection, and the answer would be lost."""
_REST_BYTES = 2**18
"""Bytes of the rest that are read at once."""
_BUSY_S = 1.0
"""Longest wait for one of the connections to end."""
_POLL_S = 0.1
_JOIN_S = 5.0


class TokenCheck:
    """Refuses requests to a loopback port that have no token, or that a web page may have sent."""

    def __init__(self, port: int, token: str) -> None:
        names = (LOOPBACK, "localhost")
        self._hosts = {f"{name}:{port}" for name in names} | ({*names} if port == 80 else set())
        self._host = f"{LOOPBACK}:{port}"
        self._token = token.encode()

    def refusal(self, headers: Message) -> Answer | None:
        """Return the answer to a request that is refused."""
        hosts = [str(host).strip().lower() for host in headers.get_all("Host", [])]
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            given = printable(shortened(", ".join(hosts))) or "missing"
            return error_answer(HTTPStatus.FORBIDDEN, f"header Host: {given}; expected {self._host}")
        if "Origin" in headers:
            return error_answer(
                HTTPStatus.FORBIDDEN, "header Origin: requests of web pages are refused; leave it out"
            )
        scheme, _, token = str(headers.get("Authorization", "")).partition(" ")
        given_token = token.strip().encode("utf-8", "replace")
        if scheme.lower() == "bearer" and hmac.compare_digest(given_token, self._token):
            return None
        problem = "a wrong token" if scheme else "missing"
        return error_answer(
            HTTPStatus.UNAUTHORIZED,
            f"header Authorization: {problem}; expected Bearer TOKEN, with the token of this port",
            ("WWW-Authenticate", 'Bearer realm="noack-netem"'),
        )


class _Arriving(io.RawIOBase):
    """What arrives from a client; it ends after a number of bytes.

    Raise TimeoutError if that takes too long altogether.
    """

    def __init__(self, connection: socket.socket, most_bytes: int, longest_s: float) -> None:
        self._connection = connection
        self.most_bytes = most_bytes
        self._until_s = time.monotonic() + longest_s

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        remaining_s = self._until_s - time.monotonic()
        if remaining_s <= 0:
            raise TimeoutError
        if self.most_bytes <= 0:
            return 0
        self._connection.settimeout(remaining_s)
        received = self._connection.recv_into(memoryview(buffer)[: self.most_bytes])
        self.most_bytes -= received
        return received


class _ConnectionHandler(BaseHTTPRequestHandler):
    """One connection, with one request."""

    protocol_version = "HTTP/1.1"
    server: "_HttpServer"

    def setup(self) -> None:
        super().setup()
        # The buffer reads ahead.
        self._arriving = _Arriving(self.connection, HEAD_BYTES + io.DEFAULT_BUFFER_SIZE, _REQUEST_S)
        self.rfile = io.BufferedReader(self._arriving)

    def handle(self) -> None:
        with suppress(OSError):  # the client has gone, or is too slow
            self.handle_one_request()
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(_REST_S)
            until_s = time.monotonic() + _REQUEST_S
            while self.connection.recv(_REST_BYTES) and time.monotonic() < until_s:
                pass

    def handle_expect_100(self) -> bool:
        refusal = self._refusal()
        if refusal is None:
            return super().handle_expect_100()
        self._send(refusal)
        return False

    def _answer(self) -> None:
        refusal = self._refusal()
        if refusal is not None:
            self._send(refusal)
            return
        length = int(self.headers.get("Content-Length", 0))
        self._arriving.most_bytes = length
        body = self.rfile.read(length)
        if len(body) == length:
            self._send(self.server.routes.answer(self.command, self.path, body))
        else:
            message = f"the body ended after {len(body)} of {length} bytes (header Content-Length)"
            self._send(error_answer(HTTPStatus.BAD_REQUEST, message))

    do_GET = do_PATCH = _answer

    def _refusal(self) -> Answer | None:
        """Return the answer to a request that is refused for its head."""
        if self._arriving.most_bytes <= 0:
            message = f"the head of the request is too large; at most {HEAD_BYTES:,} bytes are read"
            return error_answer(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, message)
        if self.server.check is not None and (refusal := self.server.check.refusal(self.headers)):
            return refusal
        if "Transfer-Encoding" in self.headers:
            message = "header Transfer-Encoding: not supported; send the body with Content-Length"
            return error_answer(HTTPStatus.LENGTH_REQUIRED, message)
        lengths = [str(length).strip() for length in self.headers.get_all("Content-Length", [])]
        if any(not (length.isascii() and length.isdigit()) for length in lengths) or len(lengths) > 1:
            given = printable(shortened(", ".join(lengths)))
            message = f"header Content-Length: {given}; expected one number of bytes"
            return error_answer(HTTPStatus.BAD_REQUEST, message)
        if lengths and (len(lengths[0]) > 18 or int(lengths[0]) > BODY_BYTES):
            message = f"the body has {shortened(lengths[0])} bytes; at most {BODY_BYTES:,} are read"
            return error_answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, message)
        return None

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a request that is not HTTP; that of another method is answered as all are."""
        status = HTTPStatus(code)
        if status == HTTPStatus.NOT_IMPLEMENTED:
            self._answer()
            return
        self._send(error_answer(status, printable(shortened(message or status.phrase, 200))))

    def _send(self, answer: Answer) -> None:
        self.connection.settimeout(_ANSWER_S)
        self.request_version = self.protocol_version  # also to a first line that is cut or has no version
        content = answer.content.encode()
        self.send_response(answer.status)
        for name, value in (
            ("Content-Type", answer.content_type),
            ("Content-Length", str(len(content))),
            ("Cache-Control", "no-store"),
            ("Connection", "close"),
            *answer.headers,
        ):
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def version_string(self) -> str:
        return "noack-netem"

    def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
        pass

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the name of the base class
        pass


class _HttpServer(ThreadingHTTPServer):
    """A server with a limited number of connections; at its end it closes them."""

    request_queue_size = 128
    daemon_threads = True
    address: str | tuple[str, int]

    def __init__(self, routes: ControlRoutes) -> None:
        super().__init__(self.address, _ConnectionHandler, bind_and_activate=False)  # type: ignore[arg-type]
        self.routes = routes
        self.check: TokenCheck | None = None
        self._places = threading.BoundedSemaphore(CONNECTIONS)
        self._lock = threading.Lock()
        self._open = dict[threading.Thread, socket.socket]()

    def get_request(self) -> tuple[socket.socket, Any]:
        try:
            return super().get_request()
        except OSError:  # no descriptor is left; the client still waits, so the loop would be busy
            time.sleep(_POLL_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(timeout=_BUSY_S):
            answer = error_answer(
                HTTPStatus.SERVICE_UNAVAILABLE, f"{CONNECTIONS} connections are open; try again later"
            )
            head = f"HTTP/1.1 {int(answer.status)} {answer.status.phrase}\r\n"
            head += f"Content-Type: {answer.content_type}\r\nConnection: close\r\n"
            head += f"Content-Length: {len(answer.content.encode())}\r\n\r\n"
            request.setblocking(False)
            with suppress(OSError):
                request.send((head + answer.content).encode())
            self.shutdown_request(request)
            return
        thread = threading.Thread(
            target=self.process_request_thread, args=(request, client_address), name="control", daemon=True
        )
        with self._lock:
            self._open[thread] = request
        try:
            thread.start()
        except RuntimeError:  # the system permits no further thread
            self._forget(thread)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._forget(threading.current_thread())

    def _forget(self, thread: threading.Thread) -> None:
        with self._lock:
            del self._open[thread]
        self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        report_line(f"control: a connection failed: {printable(repr(sys.exception()))}")

    def close_connections(self) -> None:
        """End the open connections, and wait for their threads."""
        with self._lock:
            threads = list(self._open)
            for connection in self._open.values():
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
        until_s = time.monotonic() + _JOIN_S
        for thread in threads:
            thread.join(max(until_s - time.monotonic(), 0))


class UnixHttpServer(_HttpServer):
    """A server on a Unix socket that only its user can reach.

    Args:
        path: where the socket will be; there must be none.
        routes: answer the requests.

    Raises:
        OSError: the socket cannot be created.
    """

    address_family = socket.AF_UNIX

    def __init__(self, path: str, routes: ControlRoutes) -> None:
        self.address = path
        super().__init__(routes)

    def server_bind(self) -> None:
        """Create the socket's file."""
        os.fchmod(self.socket.fileno(), 0o600)  # on Linux, the mode of the file that bind creates
        self.socket.bind(self.server_address)
        self.server_name, self.server_port = "localhost", 0


class TcpHttpServer(_HttpServer):
    """A server on a loopback port, for requests with a token.

    Args:
        port: its port; 0 takes a free one.
        token: the token.
        routes: answer the requests.

    Raises:
        OSError: the port is in use.
    """

    def __init__(self, port: int, token: str, routes: ControlRoutes) -> None:
        self.address = LOOPBACK, port
        self._token = token
        super().__init__(routes)

    def server_bind(self) -> None:
        """Take the port; requests need its number and the token."""
        TCPServer.server_bind(self)  # that of HTTPServer looks up the host's name, which may take seconds
        self.server_name, self.server_port = LOOPBACK, self.socket.getsockname()[1]
        self.check = TokenCheck(self.server_port, self._token)


@contextmanager
def serving(server: _HttpServer) -> Iterator[None]:
    """Serve in a thread within the context.

    Raises:
        OSError: the socket cannot be listened on.
    """
    try:
        server.server_bind()
        server.server_activate()
        thread = threading.Thread(target=server.serve_forever, args=(_POLL_S,), name="control", daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join(_JOIN_S)
            server.close_connections()
    finally:
        server.server_close()

"""Serves the page on loopback, to requests that know its secret and come from the page itself.

Every user of the machine can connect to loopback, and so can every page that a browser shows. So
everything is under a path that begins with a secret. A request with another host name (DNS
rebinding) or from another origin is refused, also for a WebSocket.

A browser is started with an address on its command line, which every user can read. So it gets
another secret, which leads to the page for processes of this user only.
"""

import asyncio
import faulthandler
import logging
import os
import secrets
import socket
import sys
import traceback
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from nicegui import ui
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from cosim.lab.lab_page import show_page
from cosim.lab.lab_services import LabServices, PageCalls
from cosim.lab.recorded_views import report_page
from cosim.output.viewer.rerun_program import HOST, OWN_HOST, socket_user
from noack.core.errors import MachineError, NoackError, one_line, printable, shortened

_END_S = 60.0
"""Time limit for the end. A live run is a process of its own and continues."""
_CAN_CHECK = sys.platform == "linux"
"""Whether the user of a connection can be seen."""
_RECONNECT_S = 60.0
"""A page that is silent for less than 0.4 of this is not cut off: a busy machine may stall."""
_SECRET_BYTES = 32
_HEADERS = {
    "referrer-policy": "no-referrer",
    "x-frame-options": "SAMEORIGIN",
    "x-content-type-options": "nosniff",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    # The rerun viewer, which is in a frame, draws in another process of the browser: while it
    # draws without a graphics card, it would keep this page from handling clicks for seconds.
    "origin-agent-cluster": "?1",
    # The framework compiles its templates in the browser, which needs unsafe-eval.
    "content-security-policy": "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self'; worker-src 'self' blob:; frame-src 'self' http://127.0.0.1:* "
    "http://localhost:*; frame-ancestors 'self'; base-uri 'self'; form-action 'self'",
}
_UNKNOWN_ADDRESS = (
    "noack lab: this is not the address of the page. Each start of noack lab has another address:"
    " open the one that its terminal shows. What follows the '?' are the settings; add it there.\n"
)
_REPORT_POLICY = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; font-src data:"
"""A run directory may come from somebody else; a report needs no scripts."""
_POLICY_VIOLATION = WebSocketClose(code=1008)


@dataclass(frozen=True)
class LabOptions:
    """What the page opens, and where it keeps files."""

    scenario: str
    """Name of a shipped scenario, or path of a scenario file."""
    settings: str
    """Further settings, as the query of an address; empty for none."""
    folder: Path
    """Scenarios are saved here."""
    runs: Path
    """Folder of the run directories."""
    port: int
    """0: the kernel chooses."""
    open_browser: bool


def serve(options: LabOptions, announce: Callable[[str], None]) -> None:
    """Serve the page; ``announce`` is called with its address once it can be opened.

    Raises:
        MachineError: the port is in use.
    """
    secret, opening = new_secret(), new_secret()
    listener = _listen(options.port)
    origin, query = f"http://{HOST}:{listener.getsockname()[1]}", f"?{options.settings}".rstrip("?")
    with LabServices(options.scenario, options.folder, options.runs) as services:
        application = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

        @ui.page("/", title="noack lab", language="en-US")
        async def lab() -> None:
            await show_page(services)

        reports = serve_reports(application, services)
        # Without a history of messages: each redraw is one. A reconnected page loads itself again.
        ui.run_with(
            application,
            title="noack lab",
            favicon="🧪",
            dark=None,
            message_history_length=0,
            show_welcome_message=False,
            gzip_middleware_factory=None,
            reconnect_timeout=_RECONNECT_S,
        )
        config = uvicorn.Config(
            AddressGuard(application, secret, opening),
            log_level="warning",
            access_log=False,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=2,
            server_header=False,
        )

        def announce_address() -> None:
            announce(f"{origin}/{secret}/{query}")
            if options.open_browser:
                webbrowser.open(f"{origin}/{opening if _CAN_CHECK else secret}/{query}")

        for logger in ("engineio.server", "asyncio"):
            logging.getLogger(logger).addFilter(refused_message)
        server = _LabServer(config, announce_address, reports.give_up)
        with listener, suppress(KeyboardInterrupt):  # Ctrl-C is how it ends
            asyncio.run(server.serve(sockets=[listener]))


def refused_message(record: logging.LogRecord) -> bool:
    """Make one line of the traceback of a message that the socket's libraries could not read."""
    error = record.exc_info[1] if record.exc_info else None
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__ if error else None)]
    in_library = any("/socketio/" in file for file in files)
    if error is not None and in_library and not any("/cosim/" in file for file in files):
        reason = shortened(one_line(error))
        record.msg = "noack lab: a message on the page's socket is refused: %s: %s"
        record.args = (type(error).__name__, printable(reason))
        record.exc_info = None
    return True


class _LabServer(uvicorn.Server):
    """A server that reports once it listens, and when it begins to end."""

    def __init__(
        self, config: uvicorn.Config, on_start: Callable[[], None], on_end: Callable[[], None]
    ) -> None:
        super().__init__(config)
        self._on_start, self._on_end = on_start, on_end

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Cancel what would delay the end, and end; if that takes too long, print a traceback and exit."""
        faulthandler.dump_traceback_later(_END_S, exit=True, file=2)  # standard error
        self._on_end()
        await super().shutdown(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen, and report it."""
        await super().startup(sockets)
        if self.started:
            self._on_start()


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
    except OSError as error:
        listener.close()
        raise MachineError(f"port {port} cannot be used: {error.strerror}") from None
    return listener


def new_secret() -> str:
    """Return a secret for the page's address."""
    return secrets.token_urlsafe(_SECRET_BYTES)


class AddressGuard:
    """An ASGI application in front of another one, which sees the secret as its root path.

    Args:
        application: the other one.
        secret: of the page.
        opening: the secret for a command line.
    """

    def __init__(self, application: ASGIApp, secret: str, opening: str) -> None:
        self._application = application
        self._root, self._opening = f"/{secret}", f"/{opening}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an admitted request on; refuse another one."""
        answer = None if scope["type"] == "lifespan" else self._answer(scope)
        if answer is not None:
            await answer(scope, receive, send)
            return

        async def protected(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.append(name, value)
            await send(message)

        await self._application({**scope, "root_path": self._root}, receive, protected)

    def _answer(self, scope: Scope) -> ASGIApp | None:
        """Return the answer to a request that is not passed on; None for others."""
        is_socket, headers = scope["type"] == "websocket", Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        is_own = len(hosts) == 1 and OWN_HOST.fullmatch(hosts[0]) is not None
        is_own = is_own and all(origin == f"http://{hosts[0]}" for origin in origins)
        # A browser names the origin of a socket; nothing else needs this socket.
        if not is_own or (is_socket and not origins):
            return _POLICY_VIOLATION if is_socket else Response(None, 403, _HEADERS)
        if _begins_with(scope, self._root):
            return None
        if is_socket:
            return _POLICY_VIOLATION
        if _begins_with(scope, self._opening) and self._is_of_this_user(scope):
            query = scope["query_string"].decode("latin-1")
            return RedirectResponse(f"{self._root}/?{query}", 303, _HEADERS)
        return PlainTextResponse(_UNKNOWN_ADDRESS, 404, _HEADERS)

    @staticmethod
    def _is_of_this_user(scope: Scope) -> bool:
        """Whether a request is from a process of this user, as a browser that was started here."""
        return socket_user(scope["client"], scope["server"]) == os.getuid()


def _begins_with(scope: Scope, root: str) -> bool:
    first = "/" + scope["path"].removeprefix("/").partition("/")[0]
    return secrets.compare_digest(first.encode(), root.encode())


def serve_reports(application: FastAPI, services: LabServices) -> PageCalls:
    """Serve the reports of recorded runs below the page's address; a missing one is written.

    Returns:
        The reports that are being written, which the end of the server gives up.
    """
    calls = PageCalls(services)

    @application.get("/report/{name}")
    async def report(name: str) -> Response:
        if name not in services.recorded():
            return PlainTextResponse(f"no run {name} is recorded in {services.runs}", 404)
        try:
            page = await calls.compute(report_page, services.runs / name)
        except asyncio.CancelledError:
            return PlainTextResponse("noack lab has ended", 503)
        except NoackError as error:
            return PlainTextResponse(str(error), 409)
        headers = {"content-security-policy": _REPORT_POLICY, "cache-control": "no-store"}
        return HTMLResponse(page, headers=headers)

    return calls

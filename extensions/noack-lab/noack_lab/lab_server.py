"""Serves the page on loopback, to requests that know its secret and come from the page itself.

Every user of the machine can connect to loopback, and so can every page that a browser shows. So
everything is under a path that begins with a secret. A request with another host name (DNS
rebinding) or from another origin is refused, also for a WebSocket.

A browser is started with an address on its command line, which every user can read. So it is given
a file that only this user can read, which leads to the page.
"""

import asyncio
import html
import multiprocessing
import os
import re
import secrets
import signal
import socket
import tempfile
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from nicegui import ui
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

import noack
from noack.extend import MachineError
from noack_lab.connections import Strangers, limited_protocol
from noack_lab.lab_page import show_page
from noack_lab.lab_services import LabServices
from noack_lab.results import report_page
from noack_lab.scenario_draft import Draft

HOST = "127.0.0.1"
_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")
_RECONNECT_S = 60.0
"""A page that is silent for less than 0.4 of this is not cut off: a busy machine may stall."""
_SECRET_BYTES = 32
_WORKERS, _NICE = 2, 10
"""Processes that compute for the page; they yield to a live run."""
_HEADERS = {
    "referrer-policy": "no-referrer",
    "x-frame-options": "SAMEORIGIN",
    "x-content-type-options": "nosniff",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    # The framework compiles its templates in the browser, which needs unsafe-eval.
    "content-security-policy": "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self'; worker-src 'self' blob:; frame-ancestors 'self'; base-uri 'self'; "
    "form-action 'self'",
}
_UNKNOWN_ADDRESS = (
    "noack lab: this is not the address of the page. Each start of noack lab has another address:"
    " open the one that its terminal shows.\n"
)
_REPORT_POLICY = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; font-src data:"
"""A run directory may come from somebody else; a report needs no scripts."""
_POLICY_VIOLATION = WebSocketClose(code=1008)


def serve(
    draft: Draft, runs: Path, port: int, announce: Callable[[str], None], *, open_browser: bool
) -> None:
    """Serve the page until Ctrl-C.

    Args:
        draft: what a visitor sees first.
        runs: folder of the run directories.
        port: on 127.0.0.1; 0: a free one.
        announce: called with the address once it can be opened.
        open_browser: whether to open it.

    Raises:
        NoackError: the port is in use.
    """
    secret, listener = secrets.token_urlsafe(_SECRET_BYTES), _listen(port)
    address = f"http://{HOST}:{listener.getsockname()[1]}/{secret}/"
    pool = multiprocessing.get_context("spawn").Pool(_WORKERS, _yield_to_others)
    with listener, pool, tempfile.TemporaryDirectory(prefix="noack-lab-") as folder:
        services = LabServices(draft, runs, pool)

        def on_start() -> None:
            announce(address)
            if open_browser:
                webbrowser.open(opening_page(Path(folder), address).as_uri())

        application = lab_application(services)
        strangers = Strangers()
        config = uvicorn.Config(
            AddressGuard(application, secret, strangers),
            http=limited_protocol(strangers),
            log_level="warning",
            access_log=False,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=2,
            server_header=False,
        )
        with suppress(KeyboardInterrupt):  # Ctrl-C is how it ends
            asyncio.run(_LabServer(config, services, on_start).serve(sockets=[listener]))


def _yield_to_others() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal is for all; the server ends them
    if hasattr(os, "nice"):  # not on Windows
        os.nice(_NICE)


def lab_application(services: LabServices) -> FastAPI:
    """Return the application: the page, and the reports of recorded runs below its address."""
    application = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @ui.page("/", title="noack lab", language="en-US")
    async def lab() -> None:
        await show_page(services)

    @application.get("/report/{name}")
    async def report(name: str) -> Response:
        if name not in services.recorded():
            return PlainTextResponse(f"no run {name} is recorded in {services.runs}", 404)
        try:
            page = await services.compute(report_page, services.runs / name)
        except noack.NoackError as error:
            return PlainTextResponse(str(error), 409)
        headers = {"content-security-policy": _REPORT_POLICY, "cache-control": "no-store"}
        return HTMLResponse(page, headers=headers)

    # Without a history of messages: each redraw is one. A reconnected page loads itself again.
    ui.run_with(
        application,
        title="noack lab",
        favicon="🧪",
        dark=False,
        message_history_length=0,
        show_welcome_message=False,
        gzip_middleware_factory=None,
        reconnect_timeout=_RECONNECT_S,
    )
    return application


def opening_page(folder: Path, address: str) -> Path:
    """Write a page that leads to an address, readable for this user only; return its path."""
    path, target = folder / "noack-lab.html", html.escape(address)
    path.touch(mode=0o600)
    path.write_text(
        f'<!doctype html><title>noack lab</title><meta http-equiv="refresh" content="0; url={target}">',
        encoding="utf-8",
    )
    return path


class _LabServer(uvicorn.Server):
    """A server that reports once it listens, and ends a live run before it ends."""

    def __init__(self, config: uvicorn.Config, services: LabServices, on_start: Callable[[], None]) -> None:
        super().__init__(config)
        self._services, self._on_start = services, on_start

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen, and report it."""
        await super().startup(sockets)
        if self.started:
            self._on_start()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End a live run, whose record is kept, and the server."""
        await self._services.end()
        await super().shutdown(sockets)


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
    except OSError as error:
        listener.close()
        raise MachineError(f"port {port} cannot be used: {error.strerror}") from None
    return listener


class AddressGuard:
    """An ASGI application in front of another one, which sees the secret as its root path."""

    def __init__(self, application: ASGIApp, secret: str, strangers: Strangers) -> None:
        self._application, self._root = application, f"/{secret}"
        self._strangers = strangers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an admitted request on; refuse another one."""
        answer = None if scope["type"] == "lifespan" else self._answer(scope)
        if answer is not None:
            await answer(scope, receive, send)
            return
        if peer := scope.get("client"):
            self._strangers.forget((peer[0], peer[1]))

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
        is_own = len(hosts) == 1 and _OWN_HOST.fullmatch(hosts[0]) is not None
        is_own = is_own and all(origin == f"http://{hosts[0]}" for origin in origins)
        # A browser names the origin of a socket; nothing else needs this socket.
        if not is_own or (is_socket and not origins):
            return _POLICY_VIOLATION if is_socket else Response(None, 403, _HEADERS)
        first = "/" + scope["path"].removeprefix("/").partition("/")[0]
        if secrets.compare_digest(first.encode(), self._root.encode()):
            return None
        return _POLICY_VIOLATION if is_socket else PlainTextResponse(_UNKNOWN_ADDRESS, 404, _HEADERS)

"""Serves the page on loopback, to requests that know its secret and come from the page itself.

Every user of the machine can connect to loopback, and so can every page that a browser shows. So
everything is under a path that begins with a secret. A request with another host name (DNS
rebinding) or from another origin is refused, also for a WebSocket.

A browser is started with an address on its command line, which every user can read. So it gets
another secret, which leads to the page for processes of this user only.
"""

import asyncio
import os
import re
import secrets
import socket
import sys
import webbrowser
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI
from nicegui import ui

from cosim.lab.lab_page import show_page
from cosim.lab.lab_services import LabServices
from cosim.lab.runs_panel import serve_reports
from cosim.output.viewer.rerun_program import socket_user
from noack.core.errors import MachineError

HOST = "127.0.0.1"


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
    listener = _listener(options.port)
    origin, query = f"http://{HOST}:{listener.getsockname()[1]}", f"?{options.settings}".rstrip("?")
    with LabServices(options.scenario, options.folder, options.runs) as services:
        application = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

        @ui.page("/", title="noack lab", language="en-US")
        async def lab() -> None:
            await show_page(services)

        serve_reports(application, services)
        # Without a history of messages: each redraw is one. A reconnected page loads itself again.
        ui.run_with(
            application, title="noack lab", favicon="🧪", dark=None, message_history_length=0,
            show_welcome_message=False, gzip_middleware_factory=None,
            reconnect_timeout=_RECONNECT_S,
        )  # fmt: skip
        config = uvicorn.Config(
            AddressGuard(application, secret, opening), log_level="warning", access_log=False,
            ws_per_message_deflate=False, timeout_graceful_shutdown=2, server_header=False,
        )  # fmt: skip

        def announced() -> None:
            announce(f"{origin}/{secret}/{query}")
            if options.open_browser:
                webbrowser.open(f"{origin}/{opening if _CAN_CHECK else secret}/{query}")

        server = _Server(config, announced)
        with listener, suppress(KeyboardInterrupt):  # Ctrl-C is how it ends
            asyncio.run(server.serve(sockets=[listener]))


_CAN_CHECK = sys.platform == "linux"
"""Whether the user of a connection can be seen."""
_RECONNECT_S = 60.0
"""A page that is silent for less than 0.4 of this is not cut off: a busy machine may stall."""


class _Server(uvicorn.Server):
    """A server that reports once it listens."""

    def __init__(self, config: uvicorn.Config, on_start: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_start = on_start

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen, and report it."""
        await super().startup(sockets)
        if self.started:
            self._on_start()


def _listener(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
    except OSError as error:
        listener.close()
        raise MachineError(f"port {port} cannot be used: {error.strerror}") from None
    return listener


Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")
_SECRET_BYTES = 32
_HEADERS = (
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    # The rerun viewer, which is in a frame, draws in another process of the browser: while it
    # draws without a graphics card, it would keep this page from handling clicks for seconds.
    (b"origin-agent-cluster", b"?1"),
    # The framework compiles its templates in the browser, which needs unsafe-eval.
    (b"content-security-policy",
     b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
     b"style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
     b"connect-src 'self'; worker-src 'self' blob:; frame-src http://127.0.0.1:* "
     b"http://localhost:*; frame-ancestors 'none'; base-uri 'self'; form-action 'self'"),
)  # fmt: skip

_UNKNOWN = (
    b"noack lab: this is not the address of the page. Each start of noack lab has another address:"
    b" open the one that its terminal shows. What follows the '?' are the settings; add it there.\n"
)


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

    def __init__(self, application: Application, secret: str, opening: str) -> None:
        self._application = application
        self._root, self._opening = f"/{secret}", f"/{opening}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an admitted request on; refuse another one."""
        if scope["type"] == "lifespan":
            await self._application(scope, receive, send)
            return
        status = self._refusal(scope)
        if status == 404 and self._may_open(scope):
            to = f"{self._root}/?".encode() + scope["query_string"]
            headers = [(b"location", to), *_HEADERS]
            await send({"type": "http.response.start", "status": 303, "headers": headers})
            await send({"type": "http.response.body"})
            return
        if status is not None:
            await _refuse(scope, receive, send, status)
            return
        await self._application({**scope, "root_path": self._root}, receive, _protected(send))

    def _refusal(self, scope: Scope) -> int | None:
        """Return the status of the refusal, or None."""
        headers = [(name, value.decode("latin-1")) for name, value in scope["headers"]]
        hosts = [value for name, value in headers if name == b"host"]
        origins = [value for name, value in headers if name == b"origin"]
        if len(hosts) != 1 or not _OWN_HOST.fullmatch(hosts[0]):
            return 403
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return 403
        if scope["type"] == "websocket" and not origins:
            return 403  # a browser names it; nothing else needs this socket
        return None if _begins(scope, self._root) else 404

    def _may_open(self, scope: Scope) -> bool:
        """Whether this is the first request of a browser that this user has started."""
        if scope["type"] != "http" or not _begins(scope, self._opening):
            return False
        return socket_user(scope["client"], scope["server"]) == os.getuid()


def _begins(scope: Scope, root: str) -> bool:
    first = "/" + scope["path"].removeprefix("/").partition("/")[0]
    return secrets.compare_digest(first.encode(), root.encode())


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = [(b"content-type", b"text/plain"), *_HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": _UNKNOWN if status == 404 else b""})


def _protected(send: Send) -> Send:
    async def protected(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return protected

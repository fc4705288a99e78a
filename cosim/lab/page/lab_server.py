"""Serves the page on loopback until it is interrupted."""

import asyncio
import socket
import sys
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from nicegui import ui

from cosim.lab.page.address_guard import AddressGuard, new_secret
from cosim.lab.page.lab_page import show_page
from cosim.lab.page.lab_services import LabServices
from cosim.lab.page.run_verdict_card import serve_reports
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

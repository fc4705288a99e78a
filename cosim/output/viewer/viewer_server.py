"""Serves one recording over HTTP on loopback, with a page that shows it, or to a window.

Every user of the machine can connect. Therefore all content is under a path that begins with a
secret; other paths do not exist. A growing file is served to each viewer at that viewer's rate.
"""

import contextlib
import os
import re
import secrets
import socketserver
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qs, quote

from cosim.output.viewer.opening_time import move_window_to, opening_time_ns, script_to_open_at
from cosim.output.viewer.rerun_program import start_rerun
from cosim.output.viewer.web_viewer import HOST, WebViewer, peer_user
from noack.core.errors import MachineError, PeerError

RECORDING = "recording.rrd"

_BLOCK = 1 << 18
_POLL_S = 0.1
_START_S = 10.0
_DRAIN_S = 2.0
_SECRET_BYTES = 32
_PATH = re.compile(r"/([^/]+)/(.*)")
_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")


class RecordingServer:
    """Serves one recording on a loopback port, and starts the viewers that request it.

    The web viewer's page comes from the same port as the recording: one forwarded port is enough
    to view it from another machine, and pages of other origins cannot read the recording.

    Args:
        path: the recording.
        follow: at the end of the file, wait for more until ``finished`` is set.

    Attributes:
        address: address of the page; the recording is ``recording.rrd`` below it. Everyone who has
            the address can read the recording.
        window_address: the same for a window. It is on a command line, which every user can read;
            therefore it is served to processes of this user only.
        requested: set when a viewer has asked for the recording.
        downloaded: set when a viewer has received all of it.

    Raises:
        MachineError: no port is available.
    """

    def __init__(self, path: Path, *, follow: bool) -> None:
        self.path = path
        self.web_viewer: WebViewer | None = None
        self.finished = threading.Event()
        self.requested = threading.Event()
        self.downloaded = threading.Event()
        self._downloads = 0
        self._lock = threading.Lock()
        self._secret, self._window_secret = (
            secrets.token_urlsafe(_SECRET_BYTES) for _ in range(2)
        )  # fmt: skip
        if not follow:
            self.finished.set()
        try:
            self._http = _Server((HOST, 0), _Handler)
        except OSError as error:
            raise MachineError(f"cannot serve {path}: {error}") from None
        self._http.recording = self
        self.origin = f"http://{HOST}:{self._http.server_address[1]}"
        self.address = f"{self.origin}/{self._secret}/"
        self.window_address = f"{self.origin}/{self._window_secret}/"
        threading.Thread(target=self._http.serve_forever, args=(0.2,), daemon=True).start()

    def start_page(self) -> str:
        """Start the web viewer and return the address at which it shows the recording.

        Raises:
            MachineError: the web viewer does not start.
        """
        self.web_viewer = WebViewer()
        return self.address

    def open_window(self) -> subprocess.Popen[bytes] | None:
        """Open a window with the recording; return None if it closed before requesting it."""
        arguments = ["--port", "auto", "--bind", HOST, self.window_address + RECORDING]
        t_ns = opening_time_ns(self.path)
        if t_ns is None:
            window = start_rerun(arguments, start_new_session=True)
        else:
            output = tempfile.TemporaryFile()  # noqa: SIM115 - the thread closes it
            window = start_rerun(arguments, output=output, start_new_session=True)
            move = partial(move_window_to, t_ns, window, output)
            threading.Thread(target=move, daemon=True).start()
        deadline = time.monotonic() + _START_S
        while not self.requested.wait(0.02) and time.monotonic() < deadline:
            if window.poll() is not None:
                return None
        return window

    def drain(self) -> None:
        """Wait a moment for downloads in progress to reach the end of the file."""
        deadline = time.monotonic() + _DRAIN_S
        while self._downloads and time.monotonic() < deadline:
            time.sleep(0.02)

    def close(self) -> None:
        """Stop serving; windows stay open."""
        if self.web_viewer is not None:
            self.web_viewer.close()
        self._http.shutdown()
        self._http.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def admits(self, secret: str, user: Callable[[], int | None]) -> bool:
        """Whether a request under this secret is answered.

        Args:
            secret: first part of the path.
            user: returns the user id of the requesting process.
        """
        if _same(secret, self._secret):
            return True
        return _same(secret, self._window_secret) and user() == os.getuid()

    @contextlib.contextmanager
    def download(self) -> Iterator[None]:
        """Count a download in progress."""
        self.requested.set()
        with self._lock:
            self._downloads += 1
        try:
            yield
        finally:
            with self._lock:
                self._downloads -= 1


def _same(secret: str, wanted: str) -> bool:
    """Whether two secrets are equal, compared in constant time."""
    return secrets.compare_digest(secret.encode(), wanted.encode())


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    block_on_close = False
    recording: RecordingServer


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        """Answer with the page, one of its files, or the recording."""
        recording = self.server.recording
        path, _, query = self.path.partition("?")
        found = _PATH.fullmatch(path)
        if not (self.path.isascii() and self.path.isprintable()):
            self.send_error(400)
        elif not _OWN_HOST.fullmatch(self.headers.get("Host", "")):
            self.send_error(403)  # DNS rebinding: a foreign name that resolves to loopback
        elif found is None or not recording.admits(found[1], lambda: peer_user(self.connection)):
            self.send_error(404)
        elif (name := found[2]) == RECORDING:
            self._send_recording(recording)
        elif name == "" and "url" not in parse_qs(query):
            self._send_to_recording(path, query)
        else:
            self._send_file(recording.web_viewer, name)

    def handle(self) -> None:
        """Serve one connection; the viewer or the web viewer's program may close it at any time."""
        with contextlib.suppress(ConnectionError, TimeoutError, HTTPException):
            super().handle()

    def end_headers(self) -> None:
        """Add a header that hides the page's address from other servers whose content it loads."""
        self.send_header("Referrer-Policy", "no-referrer")
        super().end_headers()

    def log_message(self, *_: Any) -> None:
        """Log nothing."""

    def _send_to_recording(self, path: str, query: str) -> None:
        """Redirect the browser to the page with the recording's address as the browser sees it."""
        address = quote(f"http://{self.headers['Host']}{path}{RECORDING}", safe="")
        self.send_response(302)
        self.send_header("Location", f"{path}?url={address}" + (f"&{query}" if query else ""))
        self.end_headers()

    def _send_recording(self, recording: RecordingServer) -> None:
        try:
            file = recording.path.open("rb")
        except OSError:
            self.send_error(404)
            return
        with file, recording.download():
            self.send_response(200)
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            while True:
                # Checked before reading, so that data written before it was set are still sent.
                finished = recording.finished.is_set()
                if block := file.read(_BLOCK):
                    self.wfile.write(block)
                elif finished:
                    break
                else:
                    recording.finished.wait(_POLL_S)
            recording.downloaded.set()

    def _send_file(self, web_viewer: WebViewer | None, name: str) -> None:
        if web_viewer is None:
            self.send_error(404)
            return
        try:
            with web_viewer.file(name) as answer:
                self.send_response(answer.status)
                for header in ("Content-Type", "rerun-final-length"):
                    if (value := answer.getheader(header)) is not None:
                        self.send_header(header, value)
                self.end_headers()
                while block := answer.read(_BLOCK):
                    self.wfile.write(block)
                t_ns = opening_time_ns(self.server.recording.path) if name == "" else None
                if t_ns is not None:
                    self.wfile.write(script_to_open_at(t_ns))
        except PeerError as error:
            self.send_error(502, str(error))

"""Serves one recording over HTTP on loopback, and starts rerun's viewers on it.

The web viewer's page and the recording come from the same port. A file that still grows is served
to each viewer at that viewer's pace.
"""

import contextlib
import ctypes
import http.client
import importlib.util
import os
import signal
import socket
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

from noack.errors import MachineError

HOST = "127.0.0.1"
RECORDING = "/recording.rrd"

_BLOCK = 1 << 18
_POLL_S = 0.1
_START_S = 10.0
_DRAIN_S = 2.0
_PR_SET_PDEATHSIG = 1


class RecordingServer:
    """Serves one recording on a loopback port, and starts the viewers that ask for it.

    The web viewer's page comes from the same port as the recording: one forwarded port is enough
    to look from another machine, and pages of other origins cannot read the recording.

    Args:
        path: the recording.
        follow: at the end of the file, wait for more until ``finish``.

    Attributes:
        requested: set when a viewer has asked for the recording.
        downloaded: set when a viewer has received all of it.

    Raises:
        MachineError: no port can be had.
    """

    def __init__(self, path: Path, *, follow: bool) -> None:
        self.path = path
        self.assets_port = 0
        self.finished = threading.Event()
        self.requested = threading.Event()
        self.downloaded = threading.Event()
        self._downloads = 0
        self._lock = threading.Lock()
        self._assets: subprocess.Popen[bytes] | None = None
        if not follow:
            self.finished.set()
        try:
            self._http = _Server((HOST, 0), _Handler)
        except OSError as error:
            raise MachineError(f"cannot serve {path}: {error}") from None
        self._http.recording = self
        self.origin = f"http://{HOST}:{self._http.server_address[1]}"
        threading.Thread(target=self._http.serve_forever, args=(0.2,), daemon=True).start()

    def start_page(self) -> str:
        """Start the web viewer and give the address at which it shows the recording.

        Raises:
            MachineError: it does not start.
        """
        self.assets_port = _free_port()
        arguments = ["--serve-web", "--bind", HOST, "--web-viewer-port", str(self.assets_port)]
        # Named a recording that a page can load by itself, the program serves the page and no
        # more; named a file it spins, and named nothing it opens another port for data.
        self._assets = _start_viewer([*arguments, self.origin + RECORDING])
        deadline = time.monotonic() + _START_S
        while self._assets.poll() is None and time.monotonic() < deadline:
            with (
                contextlib.suppress(OSError),
                socket.create_connection((HOST, self.assets_port), timeout=1),
            ):
                return f"{self.origin}/?url={quote(self.origin + RECORDING, safe='')}"
            time.sleep(0.02)
        raise MachineError("rerun's web viewer did not start")

    def open_window(self) -> subprocess.Popen[bytes] | None:
        """Open a window on the recording; None if it closed before it asked for the recording."""
        window = _start_viewer(
            ["--port", "auto", "--bind", HOST, self.origin + RECORDING], start_new_session=True
        )
        deadline = time.monotonic() + _START_S
        while not self.requested.wait(0.02) and time.monotonic() < deadline:
            if window.poll() is not None:
                return None
        return window

    def finish(self) -> None:
        """Let downloads end at the end of the file."""
        self.finished.set()

    def drain(self) -> None:
        """Give downloads in progress a moment to reach the end of the file."""
        deadline = time.monotonic() + _DRAIN_S
        while self._downloads and time.monotonic() < deadline:
            time.sleep(0.02)

    def close(self) -> None:
        """Stop serving; windows stay open."""
        if self._assets is not None:
            end_process(self._assets)
        self._http.shutdown()
        self._http.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    block_on_close = False
    recording: RecordingServer


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        """Answer with the recording, or with a file of the web viewer."""
        if self.headers.get("Host", "").partition(":")[0] not in (HOST, "localhost"):
            self.send_error(403)  # a foreign name made to resolve to loopback
        elif self.path == RECORDING:
            self._send_recording(self.server.recording)
        else:
            self._send_asset(self.server.recording.assets_port)

    def handle(self) -> None:
        """Serve one connection; a viewer may break it at any time."""
        with contextlib.suppress(ConnectionError):
            super().handle()

    def log_message(self, *_: Any) -> None:
        """Say nothing."""

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
                # Asked before reading, so that what was written before it was set is still sent.
                finished = recording.finished.is_set()
                if block := file.read(_BLOCK):
                    self.wfile.write(block)
                elif finished:
                    break
                else:
                    recording.finished.wait(_POLL_S)
            recording.downloaded.set()

    def _send_asset(self, port: int) -> None:
        source = http.client.HTTPConnection(HOST, port, timeout=10)
        with contextlib.closing(source):
            try:
                source.request("GET", self.path)
                answer = source.getresponse()
            except (OSError, UnicodeError, http.client.HTTPException):  # or no path of HTTP
                self.send_error(404)
                return
            self.send_response(answer.status)
            for name in ("Content-Type", "rerun-final-length"):
                if (value := answer.getheader(name)) is not None:
                    self.send_header(name, value)
            self.end_headers()
            while block := answer.read(_BLOCK):
                self.wfile.write(block)


def end_process(process: "subprocess.Popen[Any]", *, patience_s: float = 0.0) -> None:
    """End a process that was asked to end ``patience_s`` ago, by SIGTERM, then by SIGKILL."""
    for wait_s, act in ((patience_s, process.terminate), (1.0, process.kill)):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(wait_s)
            return
        act()
    process.wait()


def _start_viewer(
    arguments: list[str], *, start_new_session: bool = False
) -> subprocess.Popen[bytes]:
    """Start rerun's program; unless it is a session of its own, it ends when this process does."""
    tied = sys.platform == "linux" and not start_new_session
    return subprocess.Popen(
        [_viewer_program(), *arguments],
        env=os.environ | {"CI": "1"},  # keeps it quiet
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=start_new_session,
        # Not SIGTERM, for which a program that stands still waits until it goes on.
        preexec_fn=partial(_prctl(), _PR_SET_PDEATHSIG, signal.SIGKILL) if tied else None,
    )


def _prctl() -> Callable[[int, int], int]:
    """Linux's; looked up here, as little as possible is to be done in a child."""
    prctl: Callable[[int, int], int] = ctypes.CDLL(None).prctl
    return prctl


def _viewer_program() -> str:
    """Path of rerun's own program: the ``rerun`` script only wraps it, and would orphan it."""
    if chosen := os.environ.get("RERUN_CLI_PATH"):
        return chosen
    spec = importlib.util.find_spec("rerun_cli")
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parent
        for name in ("Rerun.app/Contents/MacOS/Rerun", "rerun", "rerun.exe"):
            if (folder / name).is_file():
                return str(folder / name)
    raise MachineError("the viewer of the package rerun-sdk is not installed")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port: int = probe.getsockname()[1]
        return port

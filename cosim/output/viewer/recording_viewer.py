"""Shows a recording: in a window if there is a display, else in a browser on loopback.

A viewer and the recorder share only the recording's file. A separate process (this module run as a
program) reads the file while it grows. It writes it to the standard input of a window, and serves it
to browsers over HTTP, to each at its own rate. A viewer that stalls delays only its own copy: the
recorder never waits, the file is complete, and no data are dropped.

Every user of the machine can connect to the server. Therefore all content is under a path that begins
with a secret; other paths do not exist. rerun's own servers of recordings (``serve_grpc``, ``rerun
--serve-web FILE``) have no secret: each user could read the run, and add to it.

A window opens a finished run at the time of the largest ‖e_c‖.
"""

import contextlib
import os
import re
import secrets
import signal
import socketserver
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from functools import partial
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler
from io import BufferedIOBase
from pathlib import Path
from types import FrameType
from typing import IO, Self
from urllib.parse import parse_qs, quote

from cosim.analysis.summary.run_summary import worst_loop
from cosim.analysis.summary.summary_model import read_summary
from cosim.output.viewer.pictures.picture import TIMELINE
from cosim.output.viewer.rerun_program import (
    HOST,
    OWN_HOST,
    WebViewer,
    end_process,
    has_display,
    move_window_to,
    require_recording,
    start_rerun,
    window_port,
)
from cosim.record.run_directory import RECORDING_FILE, SUMMARY_FILE, loop_of_file, read_object
from netem.core.clock import NS_PER_S
from netem.core.errors import ExitStatus, MachineError, PeerError, why
from netem.core.system_processes import python_command

RECORDING = "recording.rrd"
"""Last part of the address of a recording."""
_BLOCK_BYTES = 1 << 18
_POLL_S = 0.1
_START_S = 10.0
"""Maximum time to wait until a new window accepts requests."""
_FAILURE_S = 1.0
"""By then a window has ended that could not be opened."""
_DRAIN_S = 2.0
"""Maximum time to wait for downloads of a finished file."""
_END_S = 5.0
"""Maximum time to wait until the serving process has ended."""
_SECRET_BYTES = 32
_PATH = re.compile(r"/([^/]+)/(.*)")
"""A path of the server: the secret, and what is requested."""
_WINDOW = "window"
"""What the serving process prints if it has opened a window."""


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
        downloaded: set when a viewer has received all of it.

    Raises:
        MachineError: no port is available.
    """

    def __init__(self, path: Path, *, follow: bool) -> None:
        self.path = path
        self.web_viewer: WebViewer | None = None
        self.finished = threading.Event()
        self.downloaded = threading.Event()
        self._downloads = 0
        self._lock = threading.Lock()
        self._secret = secrets.token_urlsafe(_SECRET_BYTES)
        if not follow:
            self.finished.set()
        try:
            self._http = _PageServer((HOST, 0), _Handler)
        except OSError as error:
            raise MachineError(f"cannot serve {path}: {why(error)}") from None
        self._http.recording = self
        self.origin = f"http://{HOST}:{self._http.server_address[1]}"
        self.address = f"{self.origin}/{self._secret}/"
        threading.Thread(target=self._http.serve_forever, args=(0.2,), daemon=True).start()

    def start_page(self) -> str:
        """Start the web viewer and return the address at which it shows the recording.

        Raises:
            MachineError: the web viewer does not start.
        """
        self.web_viewer = WebViewer()
        return self.address

    def open_window(self) -> subprocess.Popen[bytes] | None:
        """Open a window with the recording; return None if it cannot be opened."""
        arguments = ["--port", "auto", "--bind", HOST, "-"]  # the recording comes on standard input
        output = tempfile.TemporaryFile()  # noqa: SIM115 - the thread closes it
        window = start_rerun(arguments, stdin=subprocess.PIPE, output=output, start_new_session=True)
        threading.Thread(target=self._feed, args=(window,), daemon=True).start()
        window_port(window, output, _START_S)
        with contextlib.suppress(subprocess.TimeoutExpired):
            window.wait(_FAILURE_S)
            output.close()
            return None
        t_ns = opening_time_ns(self.path)
        if t_ns is not None:
            move = partial(move_window_to, TIMELINE, t_ns, window, output)
            threading.Thread(target=move, daemon=True).start()
        return window

    def _feed(self, window: "subprocess.Popen[bytes]") -> None:
        """Write the recording to a window, until its end or that of the window."""
        assert window.stdin is not None
        with contextlib.suppress(OSError), window.stdin, self.path.open("rb") as file:
            self.send(file, window.stdin)

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

    def has_secret(self, text: str) -> bool:
        """Whether a text is the secret, compared in constant time."""
        return secrets.compare_digest(text.encode(), self._secret.encode())

    def send(self, file: IO[bytes], viewer: IO[bytes] | BufferedIOBase) -> None:
        """Copy the recording to a viewer; wait for what is still to come."""
        with self._lock:
            self._downloads += 1
        try:
            while True:
                # Checked before reading, so that data written before it was set are still sent.
                is_finished = self.finished.is_set()
                if block := file.read(_BLOCK_BYTES):
                    viewer.write(block)
                elif is_finished:
                    self.downloaded.set()
                    return
                else:
                    self.finished.wait(_POLL_S)
        finally:
            with self._lock:
                self._downloads -= 1


class _PageServer(socketserver.ThreadingTCPServer):
    daemon_threads = True
    block_on_close = False
    recording: RecordingServer


class _Handler(BaseHTTPRequestHandler):
    server: _PageServer

    def do_GET(self) -> None:
        """Answer with the page, one of its files, or the recording."""
        recording = self.server.recording
        path, _, query = self.path.partition("?")
        match = _PATH.fullmatch(path)
        if not (self.path.isascii() and self.path.isprintable()):
            self.send_error(400)
        elif not OWN_HOST.fullmatch(self.headers.get("Host", "")):
            self.send_error(403)  # DNS rebinding: a foreign name that resolves to loopback
        elif match is None or not recording.has_secret(match[1]):
            self.send_error(404)
        elif (name := match[2]) == RECORDING:
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

    def log_message(self, *_: object) -> None:
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
        with file:
            self.send_response(200)
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            recording.send(file, self.wfile)

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
                while block := answer.read(_BLOCK_BYTES):
                    self.wfile.write(block)
        except PeerError as error:
            self.send_error(502, str(error))


class LiveView:
    """Shows a recording while it is written.

    Args:
        native: open a window (True), serve a browser (False), or decide by the display (None); if
            the window cannot be opened, serve a browser.

    Attributes:
        url: address to open in a browser; None for a window, and while nothing is shown.
        status: one line: where the recording is shown, or why it is not.
    """

    def __init__(self, *, native: bool | None = None) -> None:
        self.url: str | None = None
        self.status = "no live view yet"
        self._native = has_display() if native is None else native
        self._process: subprocess.Popen[str] | None = None

    @property
    def pid(self) -> int | None:
        """Process that serves the recording, leader of its process group; None if there is none."""
        return None if self._process is None else self._process.pid

    def show(self, path: Path) -> None:
        """Start to show the file, which exists and may grow; ``status`` reports a failure."""
        command = python_command("-m", "cosim.output.viewer.recording_viewer", path)
        if self._native:
            command.append("--native")
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            # Ctrl-C ends the run only; the viewer ends on request, or when this process has ended.
            start_new_session=True,
        )
        assert self._process.stdout is not None
        answer = self._process.stdout.readline().strip()
        if answer == _WINDOW:
            self.status = "live view: in a window"
        elif answer.startswith("http://"):
            self.url = answer
            self.status = f"live view: {answer}"
        else:
            self.close()
            self.status = f"no live view: {answer or 'the viewer did not start'}"

    def finish(self) -> None:
        """Report that the file is complete: downloads in progress end at its end."""
        self._send_command("finish")

    def close(self, *, keep: bool = False) -> None:
        """Stop serving; a window stays open and keeps the received data.

        Args:
            keep: continue to serve until SIGTERM ends the process ``pid``.
        """
        if self._process is None:
            return
        self._send_command("keep" if keep else "finish")
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
        if not keep:
            end_process(self._process, patience_s=_END_S)
            self._process = None
            self.url = None
            self.status = "the live view is closed"

    def _send_command(self, word: str) -> None:
        if self._process is None:
            return
        assert self._process.stdin is not None
        # A viewer that crashed or was ended by the user does not affect the run.
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(word + "\n")
            self._process.stdin.flush()


def view_recording(path: Path, *, native: bool | None = None) -> None:
    """Show a finished recording until its window is closed, or in the browser until Ctrl-C.

    Args:
        path: the recording.
        native: open a window (True), serve a browser on loopback (False), or decide by the display
            (None); if the window cannot be opened, serve a browser.

    Raises:
        CallerError: there is no such file, or it is not a recording.
        MachineError: the viewer cannot be started.
        SystemExit: on SIGTERM or SIGHUP.
    """
    require_recording(path)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _exit)
    with contextlib.suppress(KeyboardInterrupt), RecordingServer(path, follow=False) as server:
        has_window = has_display() if native is None else native
        window = server.open_window() if has_window else None
        if window is not None:
            window.wait()
            return
        print(f"Open {server.start_page()} in a browser. Ctrl-C ends.", flush=True)
        threading.Event().wait()


def opening_time_ns(recording: Path) -> int | None:
    """Return the time of the largest ‖e_c‖ from the recording's summary; None without a summary.

    In the recording of the run, it is that of the worst loop.
    """
    name = loop_of_file(recording.name, RECORDING_FILE)
    summary = read_summary(read_object(recording.parent / SUMMARY_FILE))
    if summary is None or name not in (None, *(loop.name for loop in summary.loops)):
        return None
    loops = {loop.number: loop for loop in summary.loops if name in (None, loop.name)}
    loop = loops[worst_loop([*loops.values()]).number]
    if loop.sup_e_c_at_s is None:
        return None
    begin_s = loop.phase_s if name is None else 0.0
    return round((begin_s + loop.sup_e_c_at_s) * NS_PER_S)


def _serve_growing(path: Path, *, native: bool, commands: Iterable[str]) -> None:
    """Serve a growing file: print where it is shown, then execute ``commands`` until their end."""
    signal.signal(signal.SIGTERM, _exit)
    if hasattr(os, "nice"):
        os.nice(10)  # lower priority than the processes of the run
    with RecordingServer(path, follow=True) as server:
        window = server.open_window() if native else None
        print(_WINDOW if window is not None else server.start_page(), flush=True)
        keep = False
        for command in commands:
            server.finished.set()
            keep = command.strip() == "keep"
        server.finished.set()
        if keep:
            threading.Event().wait()
        server.drain()


def _exit(_number: int, _frame: FrameType | None) -> None:
    sys.exit(ExitStatus.TERMINATED)


def _main() -> int:
    try:
        _serve_growing(Path(sys.argv[1]), native="--native" in sys.argv[2:], commands=sys.stdin)
    except MachineError as error:
        print(error, flush=True)
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(_main())

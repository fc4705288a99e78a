"""Shows a recording: in a window if there is a display, else in a browser on loopback.

A viewer and the recorder share only the recording's file. A separate process (this module run as a
program) reads the file while it grows and serves it over HTTP, to each viewer at its own rate. A
viewer that stalls delays only its own download: the recorder never waits, the file is complete, and
no data are dropped.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from types import FrameType

from cosim.output.viewer.rerun_program import end_process
from cosim.output.viewer.viewer_server import RecordingServer
from noack.core.errors import CallerError, ExitStatus, MachineError
from noack.core.process_limits import python_command

_MAGIC = b"RRF"
_PATIENCE_S = 5.0
_WINDOW = "window"


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


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
        self._host: subprocess.Popen[str] | None = None

    @property
    def pid(self) -> int | None:
        """Process that serves the recording, leader of its process group; None if there is none."""
        return None if self._host is None else self._host.pid

    def show(self, path: Path) -> None:
        """Start to show the file, which exists and may grow; ``status`` reports a failure."""
        command = python_command("-m", "cosim.output.viewer.live_viewer", path)
        if self._native:
            command.append("--native")
        self._host = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            # Ctrl-C ends the run only; the viewer ends on request, or when this process has ended.
            start_new_session=True,
        )
        assert self._host.stdout is not None
        answer = self._host.stdout.readline().strip()
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
        self._say("finish")

    def close(self, *, keep: bool = False) -> None:
        """Stop serving; a window stays open and keeps the received data.

        Args:
            keep: continue to serve until SIGTERM ends the process ``pid``.
        """
        if self._host is None:
            return
        self._say("keep" if keep else "finish")
        for pipe in (self._host.stdin, self._host.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
        if not keep:
            end_process(self._host, patience_s=_PATIENCE_S)
            self._host = None
            self.url = None
            self.status = "the live view is closed"

    def _say(self, word: str) -> None:
        if self._host is None:
            return
        assert self._host.stdin is not None
        # A viewer that crashed or was ended by the user does not affect the run.
        with contextlib.suppress(OSError, ValueError):
            self._host.stdin.write(word + "\n")
            self._host.stdin.flush()


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
    if not path.is_file():
        raise CallerError(f"{path}: no such recording")
    with path.open("rb") as file:
        if not file.read(len(_MAGIC)).startswith(_MAGIC):
            raise CallerError(f"{path}: not a rerun recording, or empty")
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _exit)
    with contextlib.suppress(KeyboardInterrupt), RecordingServer(path, follow=False) as server:
        wanted = has_display() if native is None else native
        window = server.open_window() if wanted else None
        if window is not None:
            window.wait()
            return
        print(f"Open {server.start_page()} in a browser. Ctrl-C ends.", flush=True)
        threading.Event().wait()


def _host(path: Path, *, native: bool, commands: Iterable[str]) -> None:
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
        _host(Path(sys.argv[1]), native="--native" in sys.argv[2:], commands=sys.stdin)
    except MachineError as error:
        print(error, flush=True)
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(_main())

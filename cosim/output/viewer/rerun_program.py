"""rerun's own program as a child process, and the web viewer that it contains.

The program serves the web viewer's files on a port of its own, on loopback only (the same server in
the Python library listens on all addresses). Any user of the machine could listen on that port once
the program has ended. Therefore the kernel selects the port, and an answer is used only if the
program still runs after it: then the port was the program's.

A layout in a recording cannot set the viewer's time cursor; only requests of rerun's client to an
open window can.
"""

import contextlib
import ctypes
import http.client
import importlib.util
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO

from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, MachineError, PeerError

NOT_INSTALLED = "the viewer's package is not installed: pip install 'noack[viewer]'"
_PR_SET_PDEATHSIG = 1
_POLL_S = 0.02
_MAGIC = b"RRF"
"""First bytes of a recording."""
HOST = "127.0.0.1"
OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")
"""The host in a request's header; another name would be that of a foreign page (DNS rebinding)."""
_WEB_START_S = 10.0
_ANSWER_S = 10.0
_SERVED_AT = re.compile(rb"(?<!\+)http://127\.0\.0\.1:(\d+)")
_RETRY_S = 0.25
_LOAD_S = 60.0
"""Maximum time until a window accepts requests."""
_TAKES_REQUESTS_AT = re.compile(rb"rerun\+http://127\.0\.0\.1:(\d+)")


def is_installed() -> bool:
    """Whether recordings can be written and shown."""
    return importlib.util.find_spec("rerun") is not None


def require_recording(path: Path) -> None:
    """Raise CallerError if a file does not exist, or is not a recording."""
    if not path.is_file():
        raise CallerError(f"{path}: no such recording")
    with path.open("rb") as file:
        if not file.read(len(_MAGIC)).startswith(_MAGIC):
            raise CallerError(f"{path}: not a rerun recording, or empty; give a run directory")


def require_viewer() -> None:
    """Check that recordings can be written and shown.

    Raises:
        CallerError: the extra that they need is not installed.
    """
    if not is_installed():
        raise CallerError(NOT_INSTALLED)


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def start_rerun(
    arguments: list[str],
    *,
    stdin: int = subprocess.DEVNULL,
    output: int | IO[bytes] = subprocess.DEVNULL,
    start_new_session: bool = False,
) -> subprocess.Popen[bytes]:
    """Start rerun's program; unless it has its own session, it ends when this process ends.

    Args:
        arguments: arguments of the program; every user of this machine can read them.
        stdin: its standard input.
        output: receives its log.
        start_new_session: whether it continues when this process ends.

    Raises:
        MachineError: the program is not installed.
    """
    tied = sys.platform == "linux" and not start_new_session
    return subprocess.Popen(
        [_program_path(), *arguments],
        # CI disables other output; the log contains the address at which it serves.
        env=os.environ | {"CI": "1", "RUST_LOG": "info"},
        stdin=stdin,
        stdout=output,
        stderr=output,
        start_new_session=start_new_session,
        # Not SIGTERM, which a stopped program does not handle until it continues.
        preexec_fn=partial(_prctl(), _PR_SET_PDEATHSIG, signal.SIGKILL) if tied else None,
    )


def logged_port(
    process: "subprocess.Popen[bytes]",
    output: IO[bytes],
    address: re.Pattern[bytes],
    within_s: float,
) -> int | None:
    """Wait until rerun logs an address; return its port, None if that takes too long.

    Args:
        process: the process, from :func:`start_rerun`.
        output: its ``output``.
        address: pattern of the address; its first group is the port.
        within_s: maximum time to wait.
    """
    deadline_s = time.monotonic() + within_s
    while process.poll() is None and time.monotonic() < deadline_s:
        if match := address.search(os.pread(output.fileno(), 1 << 16, 0)):
            return int(match[1])
        time.sleep(_POLL_S)
    return None


def end_process(
    process: "subprocess.Popen[bytes] | subprocess.Popen[str]", *, patience_s: float = 0.0
) -> None:
    """End a process that was asked to end ``patience_s`` ago, by SIGTERM, then by SIGKILL."""
    for wait_s, act in ((patience_s, process.terminate), (1.0, process.kill)):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(wait_s)
            return
        act()
    process.wait()


def _prctl() -> Callable[[int, int], int]:
    """Return Linux's prctl; looked up here, since a forked child should do very little."""
    prctl: Callable[[int, int], int] = ctypes.CDLL(None).prctl
    return prctl


def _program_path() -> str:
    """Return the path of rerun's own program; the ``rerun`` script is a wrapper and orphans it."""
    if path := os.environ.get("RERUN_CLI_PATH"):
        return path
    spec = importlib.util.find_spec("rerun_cli")
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parent
        for name in ("Rerun.app/Contents/MacOS/Rerun", "rerun", "rerun.exe"):
            if (folder / name).is_file():
                return str(folder / name)
    raise MachineError(NOT_INSTALLED)


class WebViewer:
    """Serves the web viewer's files until it is closed.

    Raises:
        MachineError: rerun's program does not start.
    """

    def __init__(self) -> None:
        # With the address of a recording that a page can load, the program only serves the page.
        # With a file it uses a whole core, and without either it opens another data port. The page
        # gets the recording's real address otherwise: every user can read a command line.
        arguments = ["--serve-web", "--bind", HOST, "--web-viewer-port", "0"]
        with tempfile.TemporaryFile() as output:
            self.process = start_rerun([*arguments, f"http://{HOST}/recording.rrd"], output=output)
            port = logged_port(self.process, output, _SERVED_AT, _WEB_START_S)
        if port is None:
            self.close()
            raise MachineError("rerun's web viewer did not start")
        self.port = port

    @contextlib.contextmanager
    def file(self, name: str) -> Iterator[http.client.HTTPResponse]:
        """Yield the answer to a request for a file; it is valid within the context.

        Raises:
            PeerError: the program has ended.
        """
        source = http.client.HTTPConnection(HOST, self.port, timeout=_ANSWER_S)
        with contextlib.closing(source):
            try:
                source.request("GET", f"/{name}")
                answer = source.getresponse()
            except (OSError, http.client.HTTPException):
                raise PeerError("rerun's web viewer does not answer") from None
            if self.process.poll() is not None:  # another program may have answered
                raise PeerError("rerun's web viewer has ended")
            yield answer

    def close(self) -> None:
        """End the program."""
        end_process(self.process)


def window_port(window: "subprocess.Popen[bytes]", output: IO[bytes], within_s: float) -> int | None:
    """Return the port at which a window accepts requests, as :func:`logged_port` does."""
    return logged_port(window, output, _TAKES_REQUESTS_AT, within_s)


def move_window_to(timeline: str, t_ns: int, window: "subprocess.Popen[bytes]", output: IO[bytes]) -> None:
    """Move the cursor of a window once the recording is loaded, unless the window closes before.

    Args:
        timeline: name of the recording's timeline.
        t_ns: time on it.
        window: the viewer's process.
        output: its log, which contains the address at which it accepts requests.
    """
    from rerun.experimental import ViewerClient  # slow to import

    with output:
        port = window_port(window, output, _LOAD_S)
    while port is not None and window.poll() is None:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.set_time(timeline, duration=t_ns / NS_PER_S, play_state="paused")
        except OSError:  # it is still loading
            time.sleep(_RETRY_S)
        else:
            return

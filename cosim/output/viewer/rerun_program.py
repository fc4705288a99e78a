"""rerun's own program, started as a child process."""

import contextlib
import ctypes
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import IO, Any

from noack.core.errors import MachineError

_PR_SET_PDEATHSIG = 1
_POLL_S = 0.02


def start_rerun(
    arguments: list[str],
    *,
    output: int | IO[bytes] = subprocess.DEVNULL,
    start_new_session: bool = False,
) -> subprocess.Popen[bytes]:
    """Start rerun's program; unless it has its own session, it ends when this process ends.

    Args:
        arguments: arguments of the program; every user of this machine can read them.
        output: receives its log.
        start_new_session: whether it continues when this process ends.

    Raises:
        MachineError: the program is not installed.
    """
    tied = sys.platform == "linux" and not start_new_session
    return subprocess.Popen(
        [_path(), *arguments],
        # CI disables other output; the log contains the address at which it serves.
        env=os.environ | {"CI": "1", "RUST_LOG": "info"},
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        start_new_session=start_new_session,
        # Not SIGTERM, which a stopped program does not handle until it continues.
        preexec_fn=partial(_prctl(), _PR_SET_PDEATHSIG, signal.SIGKILL) if tied else None,
    )


def logged_port(
    process: "subprocess.Popen[Any]", output: IO[bytes], address: re.Pattern[bytes], within_s: float
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
        if found := address.search(os.pread(output.fileno(), 1 << 16, 0)):
            return int(found[1])
        time.sleep(_POLL_S)
    return None


def end_process(process: "subprocess.Popen[Any]", *, patience_s: float = 0.0) -> None:
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


def _path() -> str:
    """Return the path of rerun's own program; the ``rerun`` script is a wrapper and orphans it."""
    if chosen := os.environ.get("RERUN_CLI_PATH"):
        return chosen
    spec = importlib.util.find_spec("rerun_cli")
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parent
        for name in ("Rerun.app/Contents/MacOS/Rerun", "rerun", "rerun.exe"):
            if (folder / name).is_file():
                return str(folder / name)
    raise MachineError("the viewer of the package rerun-sdk is not installed")

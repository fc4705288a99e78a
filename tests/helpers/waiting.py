"""Waiting for what other processes and threads do, with a deadline."""

import contextlib
import os
import time
from collections.abc import Callable

import psutil

PATIENCE_S = 300.0
"""Timeout for events that never happen; no test measures time with it."""


def wait_for(condition: Callable[[], object]) -> None:
    """Return once a condition holds; fail if it still does not after ``PATIENCE_S``."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "timed out"
        time.sleep(0.02)


def is_left(group: int) -> bool:
    """Whether a process of the group is alive; a zombie does not count."""
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                return True
    return False

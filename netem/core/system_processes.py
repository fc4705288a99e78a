"""Processes of the system: limits on them (``ulimit``), cores, and how Python children start.

A child imports nothing from the current folder.
"""

import errno
import math
import os
import sys
from contextlib import suppress

from netem.core.errors import MachineError, one_line

with suppress(ImportError):  # Windows has no limits
    import resource

_LEAST_OPEN_FILES = 64
"""Open files of a process of a run, up to 40, and some more."""
_ADDRESS_SPACE_BYTES = 3_000_000_000
"""Address space of a launcher, 2.8 GB, most of it never used; it has 0.3 GB in memory."""
QUICK_IMPORTS = {
    "OPENBLAS_NUM_THREADS": "1",  # numpy starts no threads
    "PYDANTIC_DISABLE_PLUGINS": "__all__",  # no search among all installed packages
}
"""Environment variables with which a process imports in less time."""
_OUT_OF_MEMORY = ("failed to map segment", "cannot allocate memory", "can't start new thread")


def require_limits() -> None:
    """Check the limits before a run; raise the limit of open files if that is permitted.

    Libraries abort, print stack traces or wait for ever when they reach a limit. Raise MachineError
    if a limit is too low.
    """
    soft, hard = _limits("RLIMIT_NOFILE")
    if soft < _LEAST_OPEN_FILES:
        if hard < _LEAST_OPEN_FILES:
            raise MachineError(
                f"at most {hard} open files are permitted; a process of a run needs "
                f"{_LEAST_OPEN_FILES}: ulimit -n 1024"
            )
        _, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (_LEAST_OPEN_FILES, hard_limit))
    soft, _ = _limits("RLIMIT_AS")
    if soft < _ADDRESS_SPACE_BYTES:
        raise MachineError(
            f"at most {_gb(soft)} of address space are permitted; a process of a run needs "
            f"{_gb(_ADDRESS_SPACE_BYTES)}: ulimit -v unlimited"
        )


def exhausted_limit(error: BaseException) -> str | None:
    """Return one line with the remedy if an error is that of a limit; None if it is not."""
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EMFILE, errno.ENFILE):
        soft, _ = _limits("RLIMIT_NOFILE")
        return f"too many open files: at most {soft} are permitted; see `ulimit -n`"
    text = one_line(error)
    is_known = isinstance(error, ImportError | RuntimeError)
    is_known = is_known and any(phrase in text.lower() for phrase in _OUT_OF_MEMORY)
    if not (is_known or isinstance(error, MemoryError) or number == errno.ENOMEM):
        return None
    soft, _ = _limits("RLIMIT_AS")
    if soft == math.inf:
        return f"out of memory: {text}"
    return f"out of memory: at most {_gb(soft)} of address space are permitted; see `ulimit -v`"


def _limits(name: str) -> tuple[float, float]:
    """Return the soft and the hard limit of this name; infinity if there is none."""
    if "resource" not in globals():
        return math.inf, math.inf
    limits = resource.getrlimit(getattr(resource, name))
    soft, hard = (math.inf if limit == resource.RLIM_INFINITY else limit for limit in limits)
    return soft, hard


def _gb(size_bytes: float) -> str:
    return f"{size_bytes / 1e9:.2g} GB"


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def python_command(*arguments: object) -> list[str]:
    """Return the command that runs this Python interpreter with the given arguments.

    With ``-P`` the interpreter does not import from the current folder, which may be writable for
    other users.
    """
    return [sys.executable, "-P", *map(str, arguments)]


def be_idle() -> None:
    """Let this thread use a core that nothing else needs."""
    if sys.platform == "linux":
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))

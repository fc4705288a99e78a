"""Python child processes: their command, which imports nothing from the current folder."""

import os
import sys


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def python_command(*arguments: object) -> list[str]:
    """Return the command that runs this Python interpreter with the given arguments.

    With ``-P`` the interpreter does not import from the current folder, which may be writable for
    other users.
    """
    return [sys.executable, "-P", *map(str, arguments)]

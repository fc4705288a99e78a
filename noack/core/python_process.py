"""Command of a Python child process that imports nothing from the current folder."""

import sys


def python_command(*arguments: object) -> list[str]:
    """Return the command that runs this Python interpreter with the given arguments.

    With ``-P`` the interpreter does not import from the current folder, which may be writable for
    other users.
    """
    return [sys.executable, "-P", *map(str, arguments)]

"""Command of a Python child process that imports nothing from the current folder."""

import sys


def python_command(*arguments: object) -> list[str]:
    """Return the command that runs this Python interpreter with the arguments given.

    With ``-P`` the interpreter does not import from the current folder, where others may be able to
    write.
    """
    return [sys.executable, "-P", *map(str, arguments)]

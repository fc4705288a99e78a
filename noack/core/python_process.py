"""How a Python child process is started: without importing from the current folder."""

import sys


def python_command(*arguments: object) -> list[str]:
    """Return the command that runs this Python interpreter with the arguments given.

    With ``-P`` the interpreter does not look for modules in the current folder, which anybody may
    have written to.
    """
    return [sys.executable, "-P", *map(str, arguments)]

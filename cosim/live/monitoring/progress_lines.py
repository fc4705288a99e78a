"""When the last line about work was printed, where there is no terminal.

The works of a command follow each other: the time until the next line counts from the last line of any of
them, or from the command's start, so that no wait without a line is longer. Elsewhere, as in a program that
uses the library, it counts from the beginning of the work.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

LINE_EVERY_S = 9.0
"""Time between two lines."""
FIRST_LINE_S = 6.0
"""Time from a command's start to its first line: the imports before this start take a second or more, too."""
_last_s = time.monotonic()
_is_command = False


@contextmanager
def lines_of_command() -> Iterator[None]:
    """Count over all works while this context lasts, from its beginning on."""
    global _is_command, _last_s
    _is_command = True
    _last_s = time.monotonic() - (LINE_EVERY_S - FIRST_LINE_S)
    try:
        yield
    finally:
        _is_command = False


def begin_work() -> None:
    """Count from now on, unless a command goes on."""
    if not _is_command:
        note_line()


def note_line() -> None:
    """Count from now on: a line is printed."""
    global _last_s
    _last_s = time.monotonic()


def until_line_s() -> float:
    """Return the time in s until a line is due; at most 0: it is due."""
    return LINE_EVERY_S - (time.monotonic() - _last_s)

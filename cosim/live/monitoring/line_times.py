"""When a command printed its last line about its work, where there is no terminal.

The works of a command follow each other: the time until the next line counts from the last line of any of
them, or from the start, so that no wait without a line is longer.
"""

import time

LINE_EVERY_S = 9.0
"""Time between two lines; the imports before this one take some tenths of a second, too."""
_last_s = time.monotonic()


def until_line_s(every_s: float) -> float:
    """Return the time in s until a line is due; at most 0: it is due."""
    return every_s - (time.monotonic() - _last_s)


def note_line() -> None:
    """Count from now on: a line is printed."""
    global _last_s
    _last_s = time.monotonic()

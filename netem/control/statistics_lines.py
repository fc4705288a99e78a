"""Statistics as JSON lines: one document of ``emulator_statistics`` per line, at intervals."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from netem.control.command_queue import CommandQueue
from netem.control.emulator_statistics import Statistics
from netem.control.statistics_thread import StatisticsThread
from netem.standard_error import say
from noack.core.errors import CallerError


@contextmanager
def statistics_lines(commands: CommandQueue, period_s: float, path: Path | None) -> Iterator[None]:
    """Write a line at the start of the context, every ``period_s``, and at its end.

    If a line cannot be written, a message on standard error reports it, and the relay continues.

    Args:
        commands: gives access to the relay; closed before the context ends.
        period_s: time between two lines.
        path: a file, which is replaced; None for standard output.

    Raises:
        CallerError: the file cannot be opened.
    """
    try:
        file = sys.stdout if path is None else path.open("w")
    except OSError as error:
        raise CallerError(f"--stats-file {path}: cannot be written ({error.strerror})") from None

    def write(document: Statistics) -> None:
        try:
            file.write(json.dumps(document) + "\n")
            file.flush()
        except OSError as error:
            name = "standard output" if path is None else path
            say(f"statistics cannot be written to {name} ({error.strerror}); the relay continues")
            # Also, closing the file writes the buffer once more; this must not fail.
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, file.fileno())
            os.close(nothing)

    try:
        with StatisticsThread(commands, period_s, write, at_end=True):
            yield
    finally:
        if path is not None:
            file.close()

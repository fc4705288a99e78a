"""Statistics as JSON lines: one object (``emulator_statistics``) per line, at intervals."""

import json
import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Self, TextIO

from netem.control.command_queue import CommandQueue, Snapshot
from netem.control.emulator_statistics import statistics
from netem.standard_error import say
from noack.core.errors import CallerError, PeerError

_PATIENCE_S = 2.0


class StatisticsLines:
    """Writes a line at once, every ``period_s``, and at the end of the context.

    It writes in a thread of its own. If that fails, a line on standard error says so, and the relay
    goes on.

    Args:
        errands: how to reach the relay; the context ends after they are closed.
        period_s: between two lines.
        path: a file, which is replaced; None for the standard output.

    Raises:
        CallerError: the file cannot be opened.
    """

    def __init__(self, commands: CommandQueue, period_s: float, path: Path | None) -> None:
        self._errands = commands
        self._period_s = period_s
        self._name = "the standard output" if path is None else str(path)
        try:
            self._file: TextIO = sys.stdout if path is None else path.open("w")
        except OSError as error:
            raise CallerError(
                f"--stats-file {path}: cannot be written ({error.strerror})"
            ) from None
        self._before: Snapshot | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="statistics", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        try:
            self._write_lines()
        except OSError as error:
            say(
                f"statistics can no longer be written to {self._name} ({error.strerror}); "
                "the relay goes on"
            )
            # What is left in the buffer must not fail again.
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, self._file.fileno())
            os.close(nothing)
        if self._file is not sys.stdout:
            self._file.close()

    def _write_lines(self) -> None:
        due_s = time.monotonic()
        while not self._stopping.wait(max(due_s - time.monotonic(), 0)):
            due_s = max(due_s + self._period_s, time.monotonic())
            with suppress(PeerError):
                self._write(self._errands.snapshot())
        self._write(self._errands.look())

    def _write(self, snapshot: Snapshot) -> None:
        self._file.write(json.dumps(statistics(snapshot, self._before)) + "\n")
        self._file.flush()
        self._before = snapshot

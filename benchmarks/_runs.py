"""Runs of noack as a user starts them: a process of their own, watched from outside."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks._report import MeasurementError

_PROGRESS = re.compile(r"^([0-9.]+)/[0-9.e+]+ s\b")
_ROUNDING_S = 0.05
"""A progress line shows tenths of a second."""

PLAIN_TERMINAL = {"FORCE_COLOR": "1", "TERM": "dumb"}
"""Has a pipe taken for a terminal that cannot redraw a line; into others goes no progress."""
FREE_PORTS = tuple(
    argument
    for role in ("plant", "sensor", "netem", "controller")
    for argument in ("--set", f"ports.{role}=0")
)
"""Lets runs of a benchmark go on beside a demo, whose ports are fixed."""


class Line(NamedTuple):
    """A line of a program's standard error, and when it was read."""

    at_s: float
    text: str


class Finished(NamedTuple):
    """A program that has ended well."""

    begun_s: float
    lines: list[Line]
    stdout: str


class NoackRun(NamedTuple):
    """A run of noack that has ended well."""

    summary: dict[str, Any]
    first_step_s: float | None
    """Wall time from process start to the first control step (:func:`first_step_s`)."""


def execute(command: Sequence[str], cwd: Path | None = None) -> Finished:
    """Run a program to its end, noting when each line of its standard error came.

    Raises:
        MeasurementError: it failed.
    """
    with tempfile.TemporaryFile("w+") as stdout:
        begun_s = time.monotonic()
        with subprocess.Popen(
            command, cwd=cwd, stdin=subprocess.DEVNULL, stdout=stdout, stderr=subprocess.PIPE,
            text=True, env=os.environ | PLAIN_TERMINAL,
        ) as process:  # fmt: skip
            assert process.stderr is not None
            lines = [Line(time.monotonic(), text.rstrip()) for text in process.stderr]
        stdout.seek(0)
        if process.returncode != 0:
            said = lines[-1].text if lines else "nothing"
            raise MeasurementError(f"{command[0]} ended with {process.returncode}, said {said!r}")
        return Finished(begun_s, lines, stdout.read())


def first_step_s(begun_s: float, lines: Iterable[Line]) -> float | None:
    """Upper bound of the time from ``begun_s`` to the first control step of a run at speed 1.

    A progress line that shows simulated time t and is read at time s proves that the run's epoch
    was at s − t or before, to the line's rounding: s − t is the epoch plus the line's way through
    the recorder to us, some hundredths of a second. The least over all lines is the best bound. The
    first control step follows the epoch by half a control period, 1 ms, which is far less than what
    the bound gives away. None if there was no progress line.
    """
    bounds_s = [
        line.at_s - (float(found[1]) - _ROUNDING_S) - begun_s
        for line in lines
        if (found := _PROGRESS.match(line.text)) is not None
    ]
    return min(bounds_s, default=None)


def noack(*arguments: str) -> NoackRun:
    """Run ``noack ARGUMENTS`` to its end and return what it measured of itself.

    Raises:
        MeasurementError: it failed.
    """
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        command = [sys.executable, "-m", "cosim.cli", *arguments, *FREE_PORTS, "--runs", runs]
        finished = execute([*command, "--json"])
    return NoackRun(json.loads(finished.stdout), first_step_s(finished.begun_s, finished.lines))

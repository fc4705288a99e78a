"""Runs of noack as a user starts them: separate processes, observed from outside."""

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

PROGRESS = re.compile(r"^([0-9.]+)/[0-9.e+]+ s\b")
"""A progress line of a run; the group is the time in the run, s."""
_ROUNDING_S = 0.05
"""Rounding error of a progress line, which shows tenths of a second."""

PLAIN_TERMINAL = {"FORCE_COLOR": "1", "TERM": "dumb"}
"""Makes noack treat a pipe as a simple terminal; other pipes receive no progress lines."""
FREE_PORTS = tuple(
    argument
    for role in ("plant", "sensor", "netem", "controller")
    for argument in ("--set", f"ports.{role}=0")
)
"""Free ports, so that a benchmark can run at the same time as a demo, whose ports are fixed."""


class Line(NamedTuple):
    """A line of a program's standard error, and the time at which it was read."""

    at_s: float
    text: str


class Finished(NamedTuple):
    """A program that has ended with exit status 0."""

    begun_s: float
    lines: list[Line]
    stdout: str


class NoackRun(NamedTuple):
    """A completed run of noack."""

    summary: dict[str, Any]
    first_step_s: float | None
    """Wall time from process start to the first control step (:func:`first_step_s`)."""


def execute(command: Sequence[str], cwd: Path | None = None) -> Finished:
    """Run a program to its end, recording the time of each line of its standard error.

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
            messages = [line.text for line in lines if not PROGRESS.match(line.text)]
            last = messages[-1] if messages else "no message"
            raise MeasurementError(f"{command[0]} ended with {process.returncode}: {last}")
        return Finished(begun_s, lines, stdout.read())


def first_step_s(begun_s: float, lines: Iterable[Line]) -> float | None:
    """Return an upper bound of the time from ``begun_s`` to the first control step at speed 1.

    A progress line that shows simulated time t and is read at time s proves that the run's epoch
    was at s − t or before, up to the line's rounding: s − t is the epoch plus the line's delay,
    some hundredths of a second. The minimum over all lines is the best bound. The first control
    step is half a control period (1 ms) after the epoch, far less than the bound's slack. None if
    there was no progress line.
    """
    bounds_s = [
        line.at_s - (float(found[1]) - _ROUNDING_S) - begun_s
        for line in lines
        if (found := PROGRESS.match(line.text)) is not None
    ]
    return min(bounds_s, default=None)


def noack(*arguments: str) -> NoackRun:
    """Run ``noack ARGUMENTS`` to its end and return its own measurements.

    Raises:
        MeasurementError: it failed.
    """
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        command = [sys.executable, "-m", "cosim.cli", *arguments, *FREE_PORTS, "--runs", runs]
        finished = execute([*command, "--json"])
    return NoackRun(json.loads(finished.stdout), first_step_s(finished.begun_s, finished.lines))

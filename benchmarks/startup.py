"""Time from the start of ``noack run`` to the first control step, and that of ``noack certify``.

The progress lines give an upper bound of this time (:func:`benchmarks._runs.first_step_s`). The
alternative is a Python that only imports the libraries that every process of a run needs. That of
``noack certify`` is one that only imports python-control, with which such loops are analysed.
"""

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, median, say
from benchmarks._runs import execute, noack
from benchmarks.fleet import Load, run

ROUNDS = 5
GOAL_S = Goal("<=", 0.6)

_IMPORT_LIBRARIES = (
    "import numpy, scipy.linalg, pydantic, zenoh, sys; print('ready', file=sys.stderr)"
)
_CERTIFY = (sys.executable, "-m", "cosim.cli", "certify", "lane_following")
_IMPORT_CONTROL = (sys.executable, "-c", "import control")
_CERTIFY_GOAL_S = Goal("<", 1)
_LOOPS = Load(20, 500.0, 5.0)
_SHORT = ("--set", "horizon_s=1")


def started() -> tuple[float, float | None]:
    """Start a short run.

    Returns:
        Wall seconds from the start of ``noack run`` to the first control step, and the launch time
        from the run's summary, if it has one.

    Raises:
        MeasurementError: the run failed or printed no progress.
    """
    found = noack("run", "lane_following", *_SHORT)
    if found.first_step_s is None:
        raise MeasurementError("the run showed no progress line")
    return found.first_step_s, found.summary.get("startup_s")


def imported_s() -> float:
    """Return wall seconds from the start of a bare Python to the end of the libraries' import."""
    finished = execute([sys.executable, "-c", _IMPORT_LIBRARIES])
    return finished.lines[-1].at_s - finished.begun_s


def cpu_s(command: Sequence[str]) -> float:
    """Return the CPU seconds of a program, which other load changes less than its duration."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    execute(command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def certify_row(ours_s: Sequence[float], imports_s: Sequence[float]) -> Row:
    """Return the row of ``noack certify`` from the rounds of both sides, CPU seconds."""
    return Row(
        "noack certify lane_following, with all limits", median(ours_s), "CPU s",
        Peer("Python that imports python-control", median(imports_s)), goal=_CERTIFY_GOAL_S,
    )  # fmt: skip


def rows_of(
    ours_s: Sequence[float], launches_s: Sequence[float], imports_s: Sequence[float]
) -> list[Row]:
    """Return the rows from the rounds of both sides, wall seconds."""
    value_s = median(ours_s)
    rows = [
        Row("noack run → first control step", value_s, "s", goal=GOAL_S,
            note="upper bound: includes a progress line's way through the recorder"),
        Row("the same, against a bare import", value_s, "s",
            Peer("Python that imports the libraries", median(imports_s))),
    ]  # fmt: skip
    if launches_s:
        rows.append(Row("of it, from launch to time 0, as the run says", median(launches_s), "s"))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    """Start several short runs, and the alternative in turn."""
    ours_s, launches_s, imports_s = [], [], []
    certify_s, control_s = [], []
    for number in range(ROUNDS):
        say(f"round {number + 1} of {ROUNDS}")
        total_s, launch_s = started()
        ours_s.append(total_s)
        imports_s.append(imported_s())
        if launch_s is not None:
            launches_s.append(launch_s)
        certify_s.append(cpu_s(_CERTIFY))
        control_s.append(cpu_s(_IMPORT_CONTROL))
    say("20 loops")
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        begun_s = time.monotonic()
        run(_LOOPS, Path(folder))
        loops_s = time.monotonic() - begun_s
    return [
        *rows_of(ours_s, launches_s, imports_s), certify_row(certify_s, control_s),
        Row("the first run of 20 loops, 5 s, without report", loops_s, "s", goal=Goal("<=", 15)),
    ]  # fmt: skip


BENCHMARK = Benchmark("startup", "Time to the first control step", measure)

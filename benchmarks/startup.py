"""From the start of ``noack run`` to the first control step; ``noack certify``; a whole demo.

The progress lines give an upper bound of the time to the first control step
(:func:`benchmarks._runs.first_step_s`). The alternative is a Python that only imports the libraries
that every process of a run needs. That of ``noack certify`` is one that only imports
python-control, with which such loops are analysed. Of the demo, missing samples, unintended losses
and late steps count: a plant step is late if it is made more than one period after its time.
"""

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks._report import Benchmark, Goal, MeasurementError, Rounds, Row, compared, say
from benchmarks._runs import execute, noack
from benchmarks.fleet import Load, run

ROUNDS = 5
OURS, IMPORTS = "noack", "Python that imports the libraries"
_IMPORT_LIBRARIES = (
    "import numpy, scipy.linalg, pydantic, zenoh, sys; print('ready', file=sys.stderr)"
)
_CERTIFY = (sys.executable, "-m", "cosim.cli", "certify", "lane_following")
_IMPORT_CONTROL = (sys.executable, "-c", "import control")
_LOOPS = Load(20, 500.0, 5.0)


def started() -> dict[str, float]:
    """Start a short run.

    Returns:
        ``first_s``, wall seconds from the start of ``noack run`` to the first control step, and
        ``launch_s``, the launch time from the run's summary.

    Raises:
        MeasurementError: the run failed or printed no progress.
    """
    found = noack("run", "lane_following", "--set", "horizon_s=1")
    if found.first_step_s is None:
        raise MeasurementError("the run showed no progress line")
    return {"first_s": found.first_step_s, "launch_s": found.summary["startup_s"]}


def imported() -> dict[str, float]:
    """Return wall seconds from the start of a bare Python to the end of the libraries' import."""
    finished = execute([sys.executable, "-c", _IMPORT_LIBRARIES])
    return {"first_s": finished.lines[-1].at_s - finished.begun_s}


def cpu_s(command: tuple[str, ...]) -> float:
    """Return the CPU seconds of a program, which other load changes less than its duration."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    execute(command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def rows_of(rounds: Rounds) -> list[Row]:
    """Return the rows of the start of a run."""
    note = "upper bound: includes a progress line's way through the recorder"
    return [
        rounds.row("noack run → first control step", "s", "first_s", OURS, goal=Goal("<=", 0.6),
                   note=note),
        rounds.row("the same, against a bare import", "s", "first_s", OURS, IMPORTS),
        rounds.row("of it, from launch to time 0, as the run says", "s", "launch_s", OURS),
    ]  # fmt: skip


def demo_rows(summary: Mapping[str, Any]) -> list[Row]:
    """Return the rows of a demo run from its summary."""
    (loop,) = summary["loops"]
    late, nothing = loop["lateness_us"]["plant"], Goal("==", 0)
    in_time = 100 * (1 - late["late_steps"] / late["steps"])
    return [
        Row("demo: missing samples", loop["missing_samples"], "samples", goal=nothing),
        Row("demo: unintended losses", loop["unintended_losses"], "datagrams", goal=nothing),
        Row("demo: plant steps within one period", in_time, "%", goal=Goal(">=", 99.9)),
        *(Row(f"demo: plant lateness, {name}", late[name], "µs") for name in ("p50", "p99", "max")),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Start several short runs, and the alternatives in turn; then 20 loops, and the demo."""
    rounds = Rounds()
    for number in range(ROUNDS):
        say(f"round {number + 1} of {ROUNDS}")
        rounds.add(OURS, started())
        rounds.add(IMPORTS, imported())
    certify = compared(
        "noack certify lane_following, with all limits", "CPU s", partial(cpu_s, _CERTIFY),
        ("Python that imports python-control", partial(cpu_s, _IMPORT_CONTROL)), Goal("<", 1),
    )  # fmt: skip
    say("20 loops")
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        begun_s = time.monotonic()
        run(_LOOPS, Path(folder))
        loops_s = time.monotonic() - begun_s
    say("noack demo, 20 s")
    return [
        *rows_of(rounds),
        certify,
        Row("the first run of 20 loops, 5 s, without report", loops_s, "s", goal=Goal("<=", 15)),
        *demo_rows(noack("demo").summary),
    ]


BENCHMARK = Benchmark("startup", "Time to the first control step; the demo", measure)

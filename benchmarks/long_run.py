"""The end of a run against its length: peak memory, and time as a multiple of real time.

Simulated runs are spooled as a live run spools its rows. Each is then completed as by
``noack summary``, which writes the record, recording, summary and report, replays the run and
judges its claims. The alternative is the end of a short run: memory should not grow with the
length.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from benchmarks._finalized_run import REPLAY
from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, say
from benchmarks._runs import execute

LENGTHS_S = (120.0, 600.0)
"""Both are replayed in a process of its own; a shorter run is not."""


class End(NamedTuple):
    """What the end of one run cost."""

    wall_s: float
    cpu_s: float
    peak_mib: float
    phases_s: Mapping[str, float] = {}


def end_of(horizon_s: float, folder: Path) -> End:
    """Simulate, spool and complete a run.

    Raises:
        MeasurementError: a step failed.
    """
    say(f"a run of {horizon_s:g} s")
    arguments = ["-m", "benchmarks._spooled_run", f"{horizon_s:g}", str(folder)]
    run_dir = Path(execute([sys.executable, *arguments]).stdout.strip())
    begun_s = time.monotonic()
    command = [sys.executable, "-m", "benchmarks._finalized_run", str(run_dir)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        output = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.monotonic() - begun_s
    if process.returncode != 0:
        raise MeasurementError(f"the end of the run failed with {process.returncode}")
    shutil.rmtree(run_dir)
    cpu_s = usage.ru_utime + usage.ru_stime
    return End(wall_s, cpu_s, usage.ru_maxrss / 1024, json.loads(output))


def rows_of(ends: Mapping[float, End]) -> list[Row]:
    """Return the rows from the ends of runs, by length in s."""
    shortest_s, longest_s = min(ends), max(ends)
    short, long, length_s = ends[shortest_s], ends[longest_s], longest_s - shortest_s

    def speed(name: str, more_s: float, goal: Goal | None = None, note: str = "") -> Row:
        # Start and end of the program cost the same for every length.
        return Row(name, length_s / max(more_s, 1e-9), "×", goal=goal, note=note or None)

    return [
        Row(f"peak memory, end of {longest_s:g} s", long.peak_mib, "MiB", goal=Goal("<=", 300)),
        Row("the same, against a short run", long.peak_mib, "MiB",
            Peer(f"end of {shortest_s:g} s", short.peak_mib)),
        Row(f"end of {longest_s:g} s", long.wall_s, "s"),
        speed("speed of the end, as a multiple of real time", long.wall_s - short.wall_s,
              note="of the additional length, replay beside the rest"),
        speed("the same, by CPU time of all processes", long.cpu_s - short.cpu_s, Goal(">=", 200)),
        speed("of it, the replay", long.phases_s[REPLAY] - short.phases_s[REPLAY],
              Goal(">=", 2000)),
        *(
            Row(f"phase: {phase}, per hour of the run",
                3600 * (took_s - short.phases_s.get(phase, 0.0)) / length_s, "s")
            for phase, took_s in long.phases_s.items()
        ),
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Complete runs of several lengths."""
    with tempfile.TemporaryDirectory(prefix="noack-long-run-") as folder:
        lengths_s = options.long_run or LENGTHS_S
        return rows_of({length_s: end_of(length_s, Path(folder)) for length_s in lengths_s})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare ``--long-run``."""
    parser.add_argument(
        "--long-run", type=float, nargs="+", metavar="SECONDS",
        help="long_run: lengths of the runs (default: 120 600)",
    )  # fmt: skip


BENCHMARK = Benchmark("long_run", "The end of a long run", measure, add_arguments)

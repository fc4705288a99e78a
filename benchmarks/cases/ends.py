"""The end of a run against its length: peak memory, and time as a multiple of real time.

Its programs are ``python -m benchmarks.cases.ends spool SECONDS FOLDER [SCENARIO]``, which makes the
directory of a run that ended without a recorder, and prints its path, and ``finalize RUN_DIR``,
which finalises it, and prints the CPU time of its replay, which takes place in another process. A run
is simulated; its rows are spooled as those of a live run are: in batches of 50 ms, with the rows of
all loops in the order of time.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.programs import execute
from benchmarks.report import Goal, MeasurementError, Peer, Row, benchmark, say
from cosim.analysis.replay import run_replay
from cosim.analysis.summary.summary_model import ReplayPart
from cosim.cli import find_scenario
from cosim.live import finalize
from cosim.live.simulated_run import simulate_run
from cosim.record.record_source import joined
from cosim.record.run_directory import RECORD, write_environment
from cosim.record.table_files import TableFile
from noack.protocol.topology import RECORDER
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.resolution import run_tables
from noack.scenario.scenario_file import load

LENGTHS_S = (120.0, 600.0)
"""Both are replayed in a process of its own; a shorter run is not."""
_BATCH_NS = 50_000_000
_SETTINGS = ("trigger.floor=1e-3",)  # without a floor, the threshold vanishes within an hour


def print_spooled(horizon_s: str, folder: str, path: str = "") -> None:
    """Simulate and spool a run; print its directory."""
    settings = (*(() if path else _SETTINGS), f"horizon_s={horizon_s}")
    scenario = load(Path(path) if path else find_scenario("lane_following"), settings)
    run_dir = simulate_run(scenario, Path(folder)).run_dir
    write_environment(run_dir, "live")
    writer = SpoolWriter(run_dir / SPOOL, RECORDER)
    for table, dtype in run_tables(scenario).items():
        file = TableFile(run_dir / RECORD / f"{table}.parquet", dtype)
        rows = joined([*file.batches()], dtype)
        rows = rows.take(np.argsort(rows["now_ns"], kind="stable"))
        ends_ns = np.arange(_BATCH_NS, rows["now_ns"].max(initial=0) + _BATCH_NS, _BATCH_NS)
        first = 0
        for batch in np.split(rows, np.searchsorted(rows["now_ns"], ends_ns)):
            if len(batch):
                writer.append(table, first, batch.tobytes())
                first += len(batch)
    writer.close()
    shutil.rmtree(run_dir / RECORD)
    print(run_dir)


def print_finalized(run_dir: str) -> None:
    """Finalise a run; print the CPU time of its replay, s."""
    from benchmarks.cases.ends import timed_verdict  # the other process has no __main__

    reopen = finalize.reopen  # first: a lazy module that is loaded later would replace the function
    vars(finalize)["stored_verdict"] = timed_verdict
    reopen(Path(run_dir))
    print(_replay_file(Path(run_dir)).read_text())


def timed_verdict(run_dir: Path) -> ReplayPart:
    """Replay a run, and note the CPU time in s."""
    begun_s = time.process_time()
    verdict = run_replay.stored_verdict(run_dir)
    _replay_file(run_dir).write_text(str(time.process_time() - begun_s))
    return verdict


def _replay_file(run_dir: Path) -> Path:
    return run_dir.with_name(f"{run_dir.name}-replay-s")


class End(NamedTuple):
    """What the end of one run cost."""

    wall_s: float
    cpu_s: float
    peak_mib: float
    replay_s: float
    """CPU time of the replay."""


def end_of(horizon_s: float, folder: Path) -> End:
    """Simulate, spool and complete a run.

    Raises:
        MeasurementError: a step failed.
    """
    say(f"a run of {horizon_s:g} s")
    program = [sys.executable, "-m", "benchmarks.cases.ends"]
    run_dir = Path(execute([*program, "spool", f"{horizon_s:g}", str(folder)]).stdout.strip())
    begun_s = time.monotonic()
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    command = [*program, "finalize", str(run_dir)]
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
    return End(wall_s, cpu_s, usage.ru_maxrss / 1024, float(output))


def rows_of(ends: Mapping[float, End]) -> Iterator[Row]:
    """Yield the rows from the ends of runs, by length in s."""
    shortest_s, longest_s = min(ends), max(ends)
    short, long, length_s = ends[shortest_s], ends[longest_s], longest_s - shortest_s

    def speed(name: str, more_s: float, goal: Goal | None = None, note: str | None = None) -> Row:
        # Start and end of the program cost the same for every length.
        return Row(name, length_s / max(more_s, 1e-9), "×", goal=goal, note=note)

    yield Row(f"peak memory, end of {longest_s:g} s", long.peak_mib, "MiB", goal=Goal("<=", 300))
    yield Row(
        "the same, against a short run",
        long.peak_mib,
        "MiB",
        Peer(f"end of {shortest_s:g} s", short.peak_mib),
    )
    yield Row(f"end of {longest_s:g} s", long.wall_s, "s")
    yield speed(
        "speed of the end, as a multiple of real time",
        long.wall_s - short.wall_s,
        note="of the additional length, replay beside the rest",
    )
    yield speed("the same, by CPU time of all processes", long.cpu_s - short.cpu_s, Goal(">=", 200))
    yield speed("of it, the replay", long.replay_s - short.replay_s, Goal(">=", 2000))


@benchmark(
    "long_run",
    "The end of a long run",
    {
        "--long-run": {
            "type": float,
            "nargs": "+",
            "metavar": "SECONDS",
            "help": "long_run: lengths of the runs (default: 120 600)",
        }
    },
)
def long_run(options: argparse.Namespace) -> Iterator[Row]:
    """Complete runs of several lengths, as by ``noack summary``.

    This writes the record, recording, summary and report, replays the run and judges its claims.
    The alternative is the end of a short run: memory should not grow with the length.
    """
    with tempfile.TemporaryDirectory(prefix="noack-long-run-") as folder:
        lengths_s = options.long_run or LENGTHS_S
        yield from rows_of({length_s: end_of(length_s, Path(folder)) for length_s in lengths_s})


if __name__ == "__main__":
    _, program, *arguments = sys.argv
    if program == "spool":
        print_spooled(*arguments)
    else:
        print_finalized(*arguments)

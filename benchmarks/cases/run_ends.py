"""The end of a run against its length: peak memory, and time as a multiple of real time.

A run is simulated; its rows are spooled as those of a live run are: in batches of 50 ms, with the
rows of all loops in the order of time. ``noack summary`` finalises it, as a run whose launcher was
killed.
"""

import argparse
import os
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.programs import NOACK, in_new_process
from benchmarks.report import Goal, MeasurementError, Peer, Row, announce, benchmark
from cosim.analysis.replay.run_replay import stored_verdict
from cosim.cli.options import find_scenario
from cosim.record.record_source import concatenate_rows
from cosim.record.run_directory import RECORD, write_environment
from cosim.record.table_files import TableFile
from cosim.simulation.virtual_time import simulate_run
from noack.protocol.roles import RECORDER
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.resolution import run_tables
from noack.scenario.scenario_file import load

LENGTHS_S = (120.0, 600.0)
"""Both are replayed in a process of its own; a shorter run is not."""
_BATCH_NS = 50_000_000
_SETTINGS = ("trigger.floor=1e-3",)  # without a floor, the threshold vanishes within an hour


def spooled_run(horizon_s: float, folder: Path) -> Path:
    """Simulate and spool a run; return its directory."""
    scenario = load(find_scenario("lane_following"), (*_SETTINGS, f"horizon_s={horizon_s}"))
    run_dir = simulate_run(scenario, folder).run_dir
    write_environment(run_dir, "live")
    writer = SpoolWriter(run_dir / SPOOL, RECORDER)
    for table, dtype in run_tables(scenario).items():
        rows = concatenate_rows([*TableFile(run_dir / RECORD / f"{table}.parquet", dtype).batches()], dtype)
        rows = rows.take(np.argsort(rows["now_ns"], kind="stable"))
        ends_ns = np.arange(_BATCH_NS, rows["now_ns"].max(initial=0) + _BATCH_NS, _BATCH_NS)
        first = 0
        for batch in np.split(rows, np.searchsorted(rows["now_ns"], ends_ns)):
            if len(batch):
                writer.append(table, first, batch.tobytes())
                first += len(batch)
    writer.close()
    shutil.rmtree(run_dir / RECORD)
    return run_dir


def replay_s(run_dir: Path) -> float:
    """Replay a run as at its end; return the CPU time in s."""
    began_s = time.process_time()
    stored_verdict(run_dir)
    return time.process_time() - began_s


class End(NamedTuple):
    """What the end of one run cost."""

    wall_s: float
    cpu_s: float
    peak_mib: float
    replay_s: float
    """CPU time of the replay."""


def completed(run_dir: Path) -> tuple[float, resource.struct_rusage]:
    """Complete a run by ``noack summary``; return its wall time in s and what the process used.

    Call it in a small process: Linux counts the memory of the process that starts another one as used
    by that one.

    Raises:
        MeasurementError: the command failed.
    """
    began_s = time.monotonic()
    process = subprocess.Popen([*NOACK, "summary", str(run_dir)], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall_s = time.monotonic() - began_s
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise MeasurementError(f"the end of the run failed with {process.returncode}")
    return wall_s, usage


def end_of(horizon_s: float, folder: Path) -> End:
    """Simulate, spool and complete a run; replay it once more."""
    announce(f"a run of {horizon_s:g} s")
    run_dir = in_new_process(spooled_run, horizon_s, folder)
    wall_s, usage = in_new_process(completed, run_dir)
    cpu_s = usage.ru_utime + usage.ru_stime
    end = End(wall_s, cpu_s, usage.ru_maxrss / 1024, in_new_process(replay_s, run_dir))
    shutil.rmtree(run_dir)
    return end


def rows_of(ends: Mapping[float, End]) -> Iterator[Row]:
    """Yield the rows from the ends of runs, by length in s."""
    shortest_s, longest_s = min(ends), max(ends)
    short, long = ends[shortest_s], ends[longest_s]
    times_s = (short.wall_s, long.wall_s), (short.cpu_s, long.cpu_s), (short.replay_s, long.replay_s)
    # Start and end of the program cost the same for every length.
    wall, cpu, replay = ((longest_s - shortest_s) / max(b - a, 1e-9) for a, b in times_s)
    peer = Peer(f"end of {shortest_s:g} s", short.peak_mib)
    note = "of the additional length, replay beside the rest"
    yield Row(f"peak memory, end of {longest_s:g} s", long.peak_mib, "MiB", goal=Goal("<=", 300))
    yield Row("the same, against a short run", long.peak_mib, "MiB", peer)
    yield Row(f"end of {longest_s:g} s", long.wall_s, "s")
    yield Row("speed of the end, as a multiple of real time", wall, "×", note=note)
    yield Row("the same, by CPU time of all processes", cpu, "×", goal=Goal(">=", 200))
    yield Row("of it, the replay", replay, "×", goal=Goal(">=", 2000))


@benchmark(
    "long_run",
    "The end of a long run",
    {"--long-run": {"type": float, "nargs": "+", "metavar": "SECONDS", "help": "lengths of long_run"}},
)
def long_run(options: argparse.Namespace) -> Iterator[Row]:
    """Complete runs of several lengths, by ``noack summary``.

    This writes the record, recording, summary and report, replays the run and checks its claims.
    The alternative is the end of a short run: memory should not grow with the length.
    """
    with tempfile.TemporaryDirectory(prefix="noack-long-run-") as folder:
        lengths_s = options.long_run or LENGTHS_S
        yield from rows_of({length_s: end_of(length_s, Path(folder)) for length_s in lengths_s})

"""The end of a run against its length: peak memory, and time as a multiple of real time.

A run is simulated; its rows are spooled as those of a live run are: in batches of 50 ms, with the
rows of all loops in the order of time. ``noack summary`` finalises it, as a run whose launcher was
killed.
"""

import resource
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.programs import execute, in_new_process
from benchmarks.report import Goal, Peer, Row, announce, benchmark
from benchmarks.rounds import Figures
from cosim.analysis.replay import replay
from cosim.cli.options import find_scenario
from cosim.record.rows import concatenate_rows
from cosim.record.run_directory import RECORD, write_environment
from cosim.record.run_record import load_record
from cosim.record.table_files import TableFile
from cosim.simulation.virtual_time import simulate_run
from noack.protocol.roles import RECORDER
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.resolution import ResolvedRun
from noack.scenario.scenario_file import load
from tests.helpers.live_runs import noack_command

_BATCH_NS = 50_000_000
_SETTINGS = ("trigger.floor=1e-3", "certificate.prove=false")
"""Without a floor, the threshold vanishes within an hour. A search takes other times for each length."""


def spooled_run(horizon_s: float, folder: Path) -> Path:
    """Simulate and spool a run; return its directory."""
    scenario = load(find_scenario("lane_following"), (*_SETTINGS, f"horizon_s={horizon_s}"))
    run_dir = simulate_run(scenario, folder).run_dir
    write_environment(run_dir, "live")
    writer = SpoolWriter(run_dir / SPOOL, RECORDER)
    for table, dtype in ResolvedRun(scenario).tables.items():
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
    replay(load_record(run_dir)).verdict()
    return time.process_time() - began_s


def completed(run_dir: Path) -> Figures:
    """Complete a run by ``noack summary``; return its times in s and its peak memory.

    Call it in a small process: Linux counts the memory of the process that starts another one as used
    by that one.
    """
    began_s = time.monotonic()
    execute(*noack_command("summary", str(run_dir)))
    wall_s, used = time.monotonic() - began_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"wall_s": wall_s, "cpu_s": used.ru_utime + used.ru_stime, "peak_mib": used.ru_maxrss / 1024}


def end_of(horizon_s: float, folder: Path) -> Figures:
    """Simulate, spool and complete a run; replay it once more. Return what this cost."""
    announce(f"a run of {horizon_s:g} s")
    run_dir = in_new_process(spooled_run, horizon_s, folder)
    figures = in_new_process(completed, run_dir)
    replayed_s = in_new_process(replay_s, run_dir)
    shutil.rmtree(run_dir)
    return {**figures, "replay_s": replayed_s}


@benchmark("long_run", "The end of a long run")
def long_run(short_s: float = 120.0, long_s: float = 600.0) -> Iterator[Row]:
    """Complete a short and a long run; memory should not grow with the length."""
    with tempfile.TemporaryDirectory(prefix="noack-long-run-") as folder:
        short, long = end_of(short_s, Path(folder)), end_of(long_s, Path(folder))
    # Start and end of the program cost the same for every length.
    added_s = (long[key] - short[key] for key in ("wall_s", "cpu_s", "replay_s"))
    wall, cpu, replay = ((long_s - short_s) / added if added > 0 else None for added in added_s)
    name, unit = f"end of a run of {long_s:g} s", "× real time"
    peer = Peer(f"end of {short_s:g} s", short["peak_mib"])
    note = "of the additional length"
    yield Row(f"{name}: peak memory", long["peak_mib"], "MiB", peer, Goal("<=", 300, of_value=True))
    yield Row(name, long["wall_s"], "s")
    yield Row(f"{name}: speed by the wall clock", wall, unit, note=note)
    yield Row(f"{name}: speed by the CPU time of all processes", cpu, unit, goal=Goal(">=", 200), note=note)
    yield Row(f"{name}: speed of the replay in it", replay, unit, goal=Goal(">=", 2000), note=note)

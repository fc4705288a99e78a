"""A shipped campaign: the speed-up by a second worker, and time and memory of a million runs.

In a round, one and then two workers run the same draws, timed from the start of the first process
to the last written file. The million runs are the user's command, with summary and page.
"""

import argparse
import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

import psutil

from benchmarks._report import Benchmark, Goal, MeasurementError, Row, compared, say
from cosim.shipped_files import find_shipped
from cosim.studies.campaign.campaign_file import load
from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.campaign_workers import local
from cosim.studies.campaign.chunk_store import Store, run_campaign

NAME = "mb_vs_zoh"
SHARED_DRAWS = 40_000
"""Draws per grid point of the rounds; enough to make the start of processes negligible."""
_LOOK_EVERY_S = 0.5


def runs_per_s(workers: int) -> float:
    """Return the throughput of the campaign with this number of workers."""
    path = find_shipped(NAME, "campaigns")
    plan = load(path)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder), grid(plan, path), SHARED_DRAWS, plan.chunk)
        begun_s = time.perf_counter()
        with local(workers) as runner:
            made = run_campaign(store, runner)
        return made / (time.perf_counter() - begun_s)


def whole(draws: int) -> tuple[float, float]:
    """Return seconds and peak MiB of the command; shared pages count once.

    Raises:
        MeasurementError: it failed.
    """
    peak_mib, ended = 0.0, threading.Event()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "cosim.cli", "campaign", NAME, "--json"]
        command += ["--draws", str(draws), "--out", folder]
        begun_s = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )

        def follow() -> None:
            nonlocal peak_mib
            first = psutil.Process(process.pid)
            while not ended.wait(_LOOK_EVERY_S):
                used = 0
                with contextlib.suppress(psutil.Error):
                    for one in (first, *first.children(recursive=True)):
                        with contextlib.suppress(psutil.Error):
                            used += one.memory_full_info().pss
                peak_mib = max(peak_mib, used / 2**20)

        follower = threading.Thread(target=follow, daemon=True)
        follower.start()
        said = process.communicate()[1]
        spent_s = time.perf_counter() - begun_s
        ended.set()
        follower.join()
    if process.returncode != 0:
        raise MeasurementError(f"noack campaign {NAME}: {said.strip().splitlines()[-1:]}")
    return spent_s, peak_mib


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the rounds, then the million runs."""
    workers = compared(
        f"{NAME}, two workers", "runs/s", partial(runs_per_s, 2),
        ("one worker", partial(runs_per_s, 1)), Goal(">=", 1.8), rounds=3,
    )  # fmt: skip
    path, draws = find_shipped(NAME, "campaigns"), options.campaign_draws
    runs = f"{len(grid(load(path), path)) * draws:,} runs"
    say(runs)
    spent_s, peak_mib = whole(draws)
    return [
        workers,
        Row(f"noack campaign {NAME} --draws {draws}", spent_s, "s", note=runs),
        Row("the same: peak memory of all its processes", peak_mib, "MiB", goal=Goal("<=", 1024)),
    ]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--campaign-draws", type=int, default=100_000, metavar="N",
        help="draws of the whole campaign at each of its grid points (100000: a million runs)",
    )  # fmt: skip


BENCHMARK = Benchmark("campaign", "A million runs", measure, _arguments)

"""A shipped campaign: the speed-up by a second worker, and time and memory of a million runs.

In a round, one and then two workers run the same draws, timed from the start of the first process
to the last written file. The million runs are the user's command, with summary and page.
"""

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import psutil

from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Row, median, say
from cosim.shipped_files import find_shipped
from cosim.studies.campaign.campaign_file import load
from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.campaign_workers import local
from cosim.studies.campaign.chunk_store import Store, run_campaign

NAME = "mb_vs_zoh"
ROUNDS = 3
SHARED_DRAWS = 40_000
"""Draws per grid point of the rounds; enough to make the start of processes negligible."""
WORKERS_GOAL = Goal(">=", 1.8)
MEMORY_GOAL = Goal("<=", 1024)
"""MiB."""
_LOOK_EVERY_S = 0.5


def runs_per_s(workers: int, draws: int) -> float:
    """Return the throughput of the campaign with this number of workers."""
    path = find_shipped(NAME, "campaigns")
    plan = load(path)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder), grid(plan, path), draws, plan.chunk)
        begun_s = time.perf_counter()
        with local(workers) as runner:
            made = run_campaign(store, runner)
        return made / (time.perf_counter() - begun_s)


class PeakMemory:
    """Peak memory of a process and its descendants; shared pages count once."""

    def __init__(self, process: psutil.Process) -> None:
        self._process, self._ended = process, threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()
        self.mib = 0.0

    def _follow(self) -> None:
        while not self._ended.wait(_LOOK_EVERY_S):
            total_bytes = 0
            with contextlib.suppress(psutil.Error):
                for one in (self._process, *self._process.children(recursive=True)):
                    with contextlib.suppress(psutil.Error):
                        total_bytes += one.memory_full_info().pss
            self.mib = max(self.mib, total_bytes / 2**20)

    def end(self) -> float:
        """Stop sampling; return the peak in MiB."""
        self._ended.set()
        self._thread.join()
        return self.mib


def whole(draws: int) -> tuple[float, float]:
    """Return seconds and peak MiB of the command.

    Raises:
        MeasurementError: it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        begun_s = time.perf_counter()
        process = subprocess.Popen(
            [
                sys.executable, "-m", "cosim.cli", "campaign", NAME,
                "--draws", str(draws), "--out", folder, "--json",
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        memory = PeakMemory(psutil.Process(process.pid))
        said = process.communicate()[1]
        spent_s, peak_mib = time.perf_counter() - begun_s, memory.end()
    if process.returncode != 0:
        raise MeasurementError(f"noack campaign {NAME}: {said.strip().splitlines()[-1:]}")
    return spent_s, peak_mib


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the rounds, then the million runs."""
    one, two = [], []
    for number in range(ROUNDS):
        say(f"{NAME}, one worker and two, round {number + 1} of {ROUNDS}")
        one.append(runs_per_s(1, SHARED_DRAWS))
        two.append(runs_per_s(2, SHARED_DRAWS))
    points = len(grid(load(path := find_shipped(NAME, "campaigns")), path))
    say(f"{points * options.campaign_draws:,} runs")
    spent_s, peak_mib = whole(options.campaign_draws)
    command = f"noack campaign {NAME} --draws {options.campaign_draws}"
    return [
        Row(f"{NAME}, two workers", median(two), "runs/s", Peer("one worker", median(one)),
            WORKERS_GOAL, paired_ratio=median(b / a for a, b in zip(one, two, strict=True))),
        Row(command, spent_s, "s", note=f"{points * options.campaign_draws:,} runs"),
        Row("the same: peak memory of all its processes", peak_mib, "MiB", goal=MEMORY_GOAL),
    ]  # fmt: skip


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--campaign-draws", type=int, default=100_000, metavar="N",
        help="draws of the whole campaign at each of its grid points (100000: a million runs)",
    )  # fmt: skip


BENCHMARK = Benchmark("campaign", "A million runs", measure, _arguments)

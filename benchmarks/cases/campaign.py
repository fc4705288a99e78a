"""A shipped campaign as a user runs it: by two workers, and a million runs."""

import argparse
import contextlib
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator

import psutil

from benchmarks.programs import NOACK
from benchmarks.report import Figures, Goal, MeasurementError, Row, announce, benchmark, compare, option

CAMPAIGN = "mb_vs_zoh"
SHARED_DRAWS = 40_000
"""Draws per grid point of the rounds; enough to make the start of processes negligible."""
_POLL_S = 0.5


def campaign_figures(draws: int, *options: str) -> Figures:
    """Run the campaign as a user does; shared pages of memory count once."""
    peak_mib, began_s = 0.0, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as output:
        command = [*NOACK, "campaign", CAMPAIGN, "--json", "--draws", str(draws), "--out", folder, *options]
        with subprocess.Popen(command, stdout=output) as process:
            first = psutil.Process(process.pid)
            while process.poll() is None:
                with contextlib.suppress(psutil.Error):
                    processes = first, *first.children(recursive=True)
                    used_bytes = sum(process.memory_full_info().pss for process in processes)
                    peak_mib = max(peak_mib, used_bytes / 2**20)
                time.sleep(_POLL_S)
        took_s = time.perf_counter() - began_s
        if process.returncode != 0:
            raise MeasurementError(f"noack campaign {CAMPAIGN} ended with {process.returncode}")
        output.seek(0)
        runs = draws * len(json.load(output)["points"])
    return {"runs": runs, "took_s": took_s, "per_s": runs / took_s, "peak_mib": peak_mib}


@benchmark(
    "campaign", "A million runs", {"--campaign-draws": option(100_000, "draws at each of ten grid points")}
)
def campaign(options: argparse.Namespace) -> Iterator[Row]:
    """Measure the speed-up of a shipped campaign by a second worker, then a million runs.

    These are the user's command, with summary and page. In a round, one and then two workers run
    the same draws.
    """
    yield compare(
        f"{CAMPAIGN}, two workers",
        "runs/s",
        lambda: campaign_figures(SHARED_DRAWS, "--workers", "2")["per_s"],
        ("one worker", lambda: campaign_figures(SHARED_DRAWS, "--workers", "1")["per_s"]),
        Goal(">=", 1.8),
        rounds=3,
    )
    draws = options.campaign_draws
    announce(f"{draws:,} draws")
    figures = campaign_figures(draws)
    note = f"{figures['runs']:,.0f} runs"
    yield Row(f"noack campaign {CAMPAIGN} --draws {draws}", figures["took_s"], "s", note=note)
    yield Row("the same: peak memory of all its processes", figures["peak_mib"], "MiB", goal=Goal("<=", 1024))

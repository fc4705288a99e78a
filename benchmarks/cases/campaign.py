"""A shipped campaign as a user runs it: by two workers, and a million runs."""

import contextlib
import json
import tempfile
import time
from collections.abc import Iterator

import psutil

from benchmarks.report import Goal, MeasurementError, Row, announce, benchmark
from benchmarks.rounds import Figures, Side, compare
from tests.helpers.live_runs import noack_command

CAMPAIGN = "mb_vs_zoh"
SHARED_DRAWS = 40_000
"""Draws per grid point of the rounds; enough to make the start of processes negligible."""
_POLL_S = 0.5


def campaign_figures(draws: int, *options: str) -> Figures:
    """Run the campaign as a user does; shared pages of memory count once."""
    peak_mib, began_s = 0.0, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as output:
        words = ("campaign", CAMPAIGN, "--json", "--draws", str(draws), "--out", folder, *options)
        with psutil.Popen(noack_command(*words), stdout=output) as process:
            while process.poll() is None:
                with contextlib.suppress(psutil.Error):
                    processes = process, *process.children(recursive=True)
                    used_bytes = sum(one.memory_full_info().pss for one in processes)
                    peak_mib = max(peak_mib, used_bytes / 2**20)
                time.sleep(_POLL_S)
        took_s = time.perf_counter() - began_s
        if process.returncode != 0:
            raise MeasurementError(f"noack campaign {CAMPAIGN} ended with {process.returncode}")
        output.seek(0)
        runs = draws * len(json.load(output)["points"])
    return {"runs": runs, "took_s": took_s, "per_s": runs / took_s, "peak_mib": peak_mib}


@benchmark("campaign", "A million runs")
def campaign(campaign_draws: int = 100_000) -> Iterator[Row]:
    """Measure the speed-up of a shipped campaign by a second worker, then a million runs."""

    def side(workers: str) -> Side:
        return lambda: campaign_figures(SHARED_DRAWS, "--workers", workers)["per_s"]

    name, peer = f"{CAMPAIGN}, two workers", ("one worker", side("1"))
    yield compare(name, "runs/s", side("2"), peer, Goal(">=", 1.8), rounds=3)
    announce(f"{campaign_draws:,} draws")
    figures = campaign_figures(campaign_draws)
    note = f"{figures['runs']:,.0f} runs"
    yield Row(f"noack campaign {CAMPAIGN} --draws {campaign_draws}", figures["took_s"], "s", note=note)
    yield Row("the same: peak memory of all its processes", figures["peak_mib"], "MiB", goal=Goal("<=", 1024))

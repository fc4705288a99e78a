"""Lateness of a 1 kHz loop of ours, against cyclictest, asyncio and ``time.sleep``.

cyclictest (Debian: rt-tests) is the kernel's own measure: a C loop on ``clock_nanosleep`` with
SCHED_FIFO, locked memory and no deep idle states; the settings that our processes ask for. Where
SCHED_FIFO is refused there is no such comparison and the goal is not judged.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks._report import Benchmark, Goal, Peer, Row, median, run, say
from benchmarks._ticks import FIFO_PRIORITY, LOOPS, Ticks, ticks

ROUNDS = 9
ROUND_S = 1
PERIOD_US = 1000
GOAL = Goal("<=", 1.5)
_HISTOGRAM_US = 20_000
_ASKED = {True: "real-time settings", False: "no settings"}


def quantile_of(histogram: Mapping[int, int], share: float) -> float:
    """Quantile of a histogram with bins of 1 µs: the middle of the bin that it falls in."""
    rank = share * sum(histogram.values())
    seen = 0
    for low_us, count in sorted(histogram.items()):
        seen += count
        if seen >= rank:
            return low_us + 0.5
    raise ValueError("an empty histogram has no quantiles")


class Kernel(NamedTuple):
    """Lateness in a round of cyclictest, µs."""

    p50_us: float
    p99_us: float
    max_us: float


def cyclictest(
    seconds: int = ROUND_S, priority: int = FIFO_PRIORITY, core: int | None = None
) -> Kernel | str:
    """Lateness in a round of cyclictest, or why there is none.

    Args:
        seconds: how long the round takes.
        priority: SCHED_FIFO priority.
        core: where it runs; None leaves that to the system.
    """
    program = shutil.which("cyclictest")
    if program is None:
        return "cyclictest is not installed (Debian: apt-get install rt-tests)"
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "cyclictest.json"
        command = [
            program, "-m", "-q", "-p", str(priority), "-i", str(PERIOD_US),
            "-D", str(seconds), "-h", str(_HISTOGRAM_US), f"--json={found}",
            *(() if core is None else ("-a", str(core))),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0 or not found.is_file():
            said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[0]
            return f"cyclictest failed, said {said!r}"
        thread = json.loads(found.read_text())["thread"]["0"]
    max_us = float(thread["max"])
    histogram = {int(low_us): int(count) for low_us, count in thread["histogram"].items()}
    return Kernel(quantile_of(histogram, 0.5), quantile_of(histogram, 0.99), max_us)


def rows_of(
    loops: Mapping[tuple[str, bool], list[Ticks]],
    kernel: Sequence[Kernel],
    no_cyclictest: str | None,
) -> list[Row]:
    """Return the rows from all rounds.

    Args:
        loops: by loop and whether it asked for the real-time settings, its rounds.
        kernel: cyclictest's rounds.
        no_cyclictest: why there are none.
    """
    ours = loops["run_loop", True]
    fifo = ours[0].granted["sched_fifo"]
    unjudged = no_cyclictest if fifo == "applied" else f"SCHED_FIFO {fifo}"
    note = f"of all {len(ours)} rounds of {ROUND_S} s; the peer's is the machine's own"
    return [
        Row(f"tick lateness p50, {_ASKED[True]}", median(t.p50_us for t in ours), "µs",
            Peer("cyclictest", median(k.p50_us for k in kernel) if kernel else None)),
        Row(f"tick lateness p99, {_ASKED[True]}", median(t.p99_us for t in ours), "µs",
            Peer("cyclictest", median(k.p99_us for k in kernel) if kernel else None),
            GOAL, unjudged=unjudged),
        Row(f"tick lateness max, {_ASKED[True]}", max(t.max_us for t in ours), "µs",
            Peer("cyclictest", max((k.max_us for k in kernel), default=None)), note=note),
        *(
            Row(f"tick lateness p99, {settings}",
                median(t.p99_us for t in loops["run_loop", asked]), "µs",
                Peer(f"{kind} loop", median(t.p99_us for t in loops[kind, asked])))
            for asked, settings in _ASKED.items() for kind in LOOPS if kind != "run_loop"
        ),
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Run all loops in turn, several times."""
    loops: dict[tuple[str, bool], list[Ticks]] = {}
    kernel: list[Kernel] = []
    missing: str | None = None
    for number in range(ROUNDS):
        say(f"round {number + 1} of {ROUNDS}")
        found = cyclictest()
        if isinstance(found, str):
            missing = found
        else:
            kernel.append(found)
        for asked in _ASKED:
            for kind in LOOPS:
                loops.setdefault((kind, asked), []).append(
                    ticks(kind, ROUND_S, PERIOD_US, asked=asked)
                )
    return rows_of(loops, kernel, missing)


BENCHMARK = Benchmark("lateness", "Lateness of a 1 kHz loop", measure)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))

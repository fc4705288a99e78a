"""Lateness of our 1 kHz loop, compared with cyclictest and asyncio.

cyclictest (Debian: rt-tests) is the kernel's own measure: a C loop on ``clock_nanosleep`` with
SCHED_FIFO, locked memory and no deep idle states, the settings that our processes request. Without
SCHED_FIFO, there is no comparison with cyclictest, and the goal is not judged.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

from benchmarks._report import Benchmark, Figures, Goal, Peer, Rounds, Row, say
from benchmarks._ticks import FIFO_PRIORITY, LOOPS, ticks

ROUNDS = 9
ROUND_S = 1
PERIOD_US = 1000
GOAL = Goal("<=", 1.5)
OURS, KERNEL = "run_loop", "cyclictest"
_HISTOGRAM_US = 20_000
_ASKED = {True: "real-time settings", False: "no settings"}


def quantile_of(histogram: Mapping[int, int], share: float) -> float:
    """Return a quantile of a histogram with bins of 1 µs: the middle of its bin."""
    rank = share * sum(histogram.values())
    seen = 0
    for low_us, count in sorted(histogram.items()):
        seen += count
        if seen >= rank:
            return low_us + 0.5
    raise ValueError("an empty histogram has no quantiles")


def cyclictest(
    seconds: int = ROUND_S, priority: int = FIFO_PRIORITY, core: int | None = None
) -> Figures | str:
    """Return the lateness in a round of cyclictest, p50, p99 and max in µs; or why there is none.

    Args:
        seconds: length of the round.
        priority: SCHED_FIFO priority.
        core: its core; None: any core.
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
    histogram = {int(low_us): int(count) for low_us, count in thread["histogram"].items()}
    quantiles = {"p50": quantile_of(histogram, 0.5), "p99": quantile_of(histogram, 0.99)}
    return {**quantiles, "max": float(thread["max"])}


def rows_of(rounds: Mapping[bool, Rounds]) -> list[Row]:
    """Return the rows, from the rounds with and without the real-time settings."""
    asked = rounds[True]
    name = f"tick lateness {{}}, {_ASKED[True]}"
    ours, kernel = (asked.of(side, "max") for side in (OURS, KERNEL))
    note = f"maximum of all {len(ours)} rounds of {ROUND_S} s; the peer's is the machine's own"
    return [
        asked.row(name.format("p50"), "µs", "p50", OURS, KERNEL),
        asked.row(name.format("p99"), "µs", "p99", OURS, KERNEL, GOAL),
        Row(name.format("max"), max(ours), "µs", Peer(KERNEL, max(kernel, default=None)),
            note=note),
        *(
            rounds[asked].row(f"tick lateness p99, {settings}", "µs", "p99", OURS, kind)
            for asked, settings in _ASKED.items() for kind in LOOPS if kind != OURS
        ),
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Run all loops in turn, several times."""
    rounds = {asked: Rounds() for asked in _ASKED}
    for number in range(ROUNDS):
        say(f"round {number + 1} of {ROUNDS}")
        rounds[True].add(KERNEL, cyclictest())
        for asked, sides in rounds.items():
            for kind in LOOPS:
                found = ticks(kind, ROUND_S, PERIOD_US, asked=asked)
                figures = {"p50": found.p50_us, "p99": found.p99_us, "max": found.max_us}
                sides.add(kind, figures)
                if asked and found.granted["sched_fifo"] != "applied":
                    sides.add(OURS, f"SCHED_FIFO {found.granted['sched_fifo']}")
    return rows_of(rounds)


BENCHMARK = Benchmark("lateness", "Lateness of a 1 kHz loop", measure)

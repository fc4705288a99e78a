"""Latency of a live run, and lateness of a loop, beside bare programs."""

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.bare_programs import LOOPS, PRIORITY, command_of
from benchmarks.programs import compiled, noack
from benchmarks.report import Figures, Goal, MeasurementError, Peer, Rounds, Row, benchmark, say

ROUNDS = 3
OURS, PING = "noack", "ping and relay in C"
P99_GOAL = Goal("<=", 2)
_OFTEN = ("--set", "trigger.beta=1e-9")
_RARELY = ("--set", 'trigger={policy="periodic", period_s=0.5}')
_LOSSLESS = ("--set", 'network.loss={model="lossless"}')


class Case(NamedTuple):
    """Runs whose events have a period, and their settings."""

    period_s: float
    round_s: float
    arguments: tuple[str, ...]
    asked: bool
    """Whether the real-time settings are requested."""
    goal: Goal
    """Of the median's ratio to that of the ping in C."""


CASES = {
    "every 2 ms, real-time settings": Case(0.002, 5.0, _OFTEN, True, Goal("<=", 1.4)),
    "every 2 ms, no settings": Case(
        0.002, 5.0, (*_OFTEN, "--set", "realtime.enabled=false"), False, Goal("<=", 1.3)
    ),
    "every 0.5 s, real-time settings": Case(0.5, 30.0, _RARELY, True, Goal("<=", 1.3)),
}


def ping(program: Path, count: int, period_s: float, *, asked: bool) -> tuple[Figures, set[str]]:
    """Send ``count`` datagrams, one every ``period_s`` of wall time, through a bare relay.

    Args:
        program: ``ping.c``, compiled.
        count: number of datagrams.
        period_s: time between two datagrams.
        asked: whether the processes request real-time settings.

    Returns:
        One-way latencies, µs (``p50``, ``p99``), and ``count``, the number received; and the
        real-time settings that were not permitted.

    Raises:
        MeasurementError: the program failed.
    """
    numbers = (count, round(period_s * 1e9), PRIORITY if asked else 0)
    command, patience_s = [str(program), *map(str, numbers)], count * period_s + 30
    try:
        done = subprocess.run(command, capture_output=True, timeout=patience_s, check=True)
        latencies_us = np.frombuffer(done.stdout, "<i8") / 1e3
        p50_us, p99_us = np.quantile(latencies_us, [0.5, 0.99]).tolist()
    except (subprocess.SubprocessError, IndexError):
        raise MeasurementError("the ping through the bare relay did not end") from None
    refused = {line.partition(":")[0] for line in done.stderr.decode().splitlines()}
    return {"p50": p50_us, "p99": p99_us, "count": len(latencies_us)}, refused


def rows_of(name: str, rounds: Rounds, refused: set[str]) -> list[Row]:
    """Return the rows of a case; ``refused`` are the real-time settings that were not applied."""
    updates, pings = (sum(rounds.of(side, "count")) for side in (OURS, PING))
    note = f"{updates:.0f} updates, {pings:.0f} pings"
    note += f"; not applied: {', '.join(sorted(refused))}" if refused else ""
    row = partial(rounds.row, unit="µs", ours=OURS, peer=PING)
    return [
        row(f"event → update, {name}, p50", quantity="p50", goal=CASES[name].goal, note=note),
        row(f"event → update, {name}, p99", quantity="p99", goal=P99_GOAL),
    ]


def in_turn(case: Case, rounds: Rounds, program: Path | None) -> set[str]:
    """Measure both sides of a case; return the settings that were not applied."""
    refused = set[str]()
    if program is not None:
        count = round(case.round_s / case.period_s)
        figures, refused = ping(program, count, case.period_s, asked=case.asked)
        rounds.add(PING, figures)
    horizon = ("--set", f"horizon_s={case.round_s}")
    (loop,) = noack("run", "lane_following", *horizon, *_LOSSLESS, *case.arguments).summary["loops"]
    found = loop["latency_us"]
    rounds.add(OURS, {"p50": found["p50"], "p99": found["p99"], "count": found["updates"]})
    for granted in loop["realtime"].values():
        refused |= {one for one, answer in granted.items() if answer.startswith("not permitted")}
    return refused


@benchmark("latency", "One-way latency")
def latency(options: argparse.Namespace) -> Iterator[Row]:
    """Measure the time from the sensor's event to the controller's update, through netem.

    Compared with a bare ping through a bare relay in C, at the same period and with the same
    real-time settings. noack's figure is that of the record of a live run; it also includes the
    sensor's trigger test, tagging and checking the datagram, the loss model, the MANSD cap and the
    record, on a machine that also runs the plant, the control plane and the recorder. Events come
    with every measurement, so that all code is in the processor's caches, or every half second.
    """
    rounds = {name: Rounds() for name in CASES}
    refused = {name: set[str]() for name in CASES}
    program = None
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        try:
            program = compiled("ping.c", Path(folder))
        except MeasurementError as error:
            for one in rounds.values():
                one.add(PING, str(error))
        for number in range(ROUNDS):
            for name, case in CASES.items():
                say(f"round {number + 1} of {ROUNDS}, {name}")
                refused[name] |= in_turn(case, rounds[name], program)
    for name, found in rounds.items():
        yield from rows_of(name, found, refused[name])


TICK_ROUNDS, ROUND_S = 9, 1
PERIOD_US = 1000
LOOP, KERNEL = "run_loop", "cyclictest"
_HISTOGRAM_US = 20_000
_ASKED = {True: "real-time settings", False: "no settings"}


def quantile_of(histogram: Mapping[int, int], share: float) -> float:
    """Return a quantile of a histogram with bins of 1 µs: the middle of its bin."""
    bins = sorted(histogram)
    seen = np.cumsum([histogram[low_us] for low_us in bins])
    return bins[int(np.searchsorted(seen, share * seen[-1]))] + 0.5


def cyclictest(seconds: int = ROUND_S, priority: int = PRIORITY, core: int | None = None) -> Figures | str:
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


def ticks(kind: str, *, asked: bool) -> tuple[Figures, Mapping[str, str]]:
    """Run a loop; return the lateness of its ticks, µs, and its real-time settings.

    Raises:
        MeasurementError: the process failed.
    """
    numbers = (round(ROUND_S * 1e6 / PERIOD_US), 1000 * PERIOD_US, PRIORITY if asked else 0)
    command = command_of("ticks", kind, *numbers)
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        raise MeasurementError(f"the {kind} loop ended with {done.returncode}")
    figures, granted = json.loads(done.stdout)
    return figures, granted


@benchmark("lateness", "Lateness of a 1 kHz loop")
def lateness(options: argparse.Namespace) -> list[Row]:
    """Run our 1 kHz loop, cyclictest and asyncio in turn.

    cyclictest (Debian: rt-tests) is the kernel's own measure: a C loop on ``clock_nanosleep`` with
    SCHED_FIFO, locked memory and no deep idle states, the settings that our processes request.
    Without SCHED_FIFO, there is no comparison with cyclictest, and the goal is not judged.
    """
    rounds = {asked: Rounds() for asked in _ASKED}
    for number in range(TICK_ROUNDS):
        say(f"round {number + 1} of {TICK_ROUNDS}")
        rounds[True].add(KERNEL, cyclictest())
        for asked, sides in rounds.items():
            for kind in LOOPS:
                figures, granted = ticks(kind, asked=asked)
                sides.add(kind, figures)
                if asked and granted["sched_fifo"] != "applied":
                    sides.add(LOOP, f"SCHED_FIFO {granted['sched_fifo']}")
    return lateness_rows(rounds)


def lateness_rows(rounds: Mapping[bool, Rounds]) -> list[Row]:
    """Return the rows, from the rounds with and without the real-time settings."""
    asked = rounds[True]
    name = f"tick lateness {{}}, {_ASKED[True]}"
    ours, kernel = (asked.of(side, "max") for side in (LOOP, KERNEL))
    note = f"maximum of all {len(ours)} rounds of {ROUND_S} s; the peer's is the machine's own"
    return [
        asked.row(name.format("p50"), "µs", "p50", LOOP, KERNEL),
        asked.row(name.format("p99"), "µs", "p99", LOOP, KERNEL, Goal("<=", 1.5)),
        Row(name.format("max"), max(ours), "µs", Peer(KERNEL, max(kernel, default=None)), note=note),
        *(
            rounds[asked].row(f"tick lateness p99, {settings}", "µs", "p99", LOOP, kind)
            for asked, settings in _ASKED.items()
            for kind in LOOPS
            if kind != LOOP
        ),
    ]

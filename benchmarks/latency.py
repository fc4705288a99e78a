"""One-way latency from the sensor's event to the controller's update, through netem.

Compared with a bare ping through a bare relay in C, and in Python (:mod:`benchmarks._ping`), at the
same period and with the same real-time settings. noack's figure is that of the record of a live
run; it also includes the sensor's trigger test, tagging and checking the datagram, the loss model,
the MANSD cap and the record, on a machine that also runs the plant, the control plane and the
recorder. Events come with every measurement, so that all code is in the processor's caches, or
every half second.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks._ping import PYTHON, ping
from benchmarks._programs import compiled
from benchmarks._report import Benchmark, Goal, MeasurementError, Rounds, Row, say
from benchmarks._runs import noack

ROUNDS = 3
OURS, C_PING, PYTHON_PING = "noack", "ping and relay in C", "ping and relay in Python"
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


def rows_of(name: str, rounds: Rounds, refused: set[str]) -> list[Row]:
    """Return the rows of a case; ``refused`` are the real-time settings that were not applied."""
    counts = [f"{sum(rounds.of(side, 'count')):.0f}" for side in (OURS, C_PING, PYTHON_PING)]
    note = f"{counts[0]} updates; {counts[1]} and {counts[2]} pings"
    note += f"; not applied: {', '.join(sorted(refused))}" if refused else ""
    return [
        rounds.row(
            f"event → update, {name}, {quantile}", "µs", quantile, OURS, peer, goal,
            note=note if goal is CASES[name].goal else None,
        )
        for peer, goals in ((C_PING, (CASES[name].goal, P99_GOAL)), (PYTHON_PING, (None, None)))
        for quantile, goal in zip(("p50", "p99"), goals, strict=True)
    ]  # fmt: skip


def in_turn(case: Case, rounds: Rounds, pings: dict[str, Sequence[str]]) -> set[str]:
    """Measure all sides of a case; return the settings that were not applied."""
    refused = set[str]()
    for side, command in pings.items():
        bare = ping(command, round(case.round_s / case.period_s), case.period_s, asked=case.asked)
        rounds.add(side, {"p50": bare.p50_us, "p99": bare.p99_us, "count": bare.received})
        refused |= set(bare.refused)
    horizon = ("--set", f"horizon_s={case.round_s}")
    summary = noack("run", "lane_following", *horizon, *_LOSSLESS, *case.arguments).summary
    found = summary["latency_us"]
    rounds.add(OURS, {"p50": found["p50"], "p99": found["p99"], "count": found["updates"]})
    for granted in summary["realtime"].values():
        refused |= {one for one, answer in granted.items() if answer.startswith("not permitted")}
    return refused


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the sides in turn, case by case."""
    rounds = {name: Rounds() for name in CASES}
    refused = {name: set[str]() for name in CASES}
    pings: dict[str, Sequence[str]] = {PYTHON_PING: PYTHON}
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        try:
            pings = {C_PING: [str(compiled("ping.c", Path(folder)))]} | pings
        except MeasurementError as error:
            for one in rounds.values():
                one.add(C_PING, str(error))
        for number in range(ROUNDS):
            for name, case in CASES.items():
                say(f"round {number + 1} of {ROUNDS}, {name}")
                refused[name] |= in_turn(case, rounds[name], pings)
    return [row for name, found in rounds.items() for row in rows_of(name, found, refused[name])]


BENCHMARK = Benchmark("latency", "One-way latency", measure)

"""One-way latency from the sensor's event to the controller's update, through netem.

Compared with a bare Python UDP ping through a bare two-socket relay (:mod:`benchmarks._ping`) at
the same period, with the same datagram size and the same real-time settings. Ours also includes the
sensor's trigger test, tagging and checking the datagram, the loss model, the MANSD cap and the
record, on a machine that also runs the plant, the control plane and the recorder. Events come with
every measurement, so that all code is in the processor's caches, or every half second.
"""

import argparse
from collections.abc import Mapping
from typing import NamedTuple

from benchmarks._ping import ping
from benchmarks._report import Benchmark, Goal, Rounds, Row, say
from benchmarks._runs import noack

ROUNDS = 3
OURS, PING = "noack", "ping through a bare relay"
_LOSSLESS = ("--set", 'network.loss={model="lossless"}')


class Case(NamedTuple):
    """Runs whose events have a period, and their settings."""

    period_s: float
    round_s: float
    arguments: tuple[str, ...]
    asked: bool = True
    """Whether the real-time settings are requested."""
    goal: Goal = Goal("<=", 1.5)
    """Of the median's ratio to the ping's."""


_OFTEN = ("--set", "trigger.beta=1e-9")
_RARELY = ("--set", 'trigger={policy="periodic", period_s=0.5}')
CASES = {
    "real-time settings": Case(0.002, 5.0, _OFTEN),
    "no settings": Case(
        0.002, 5.0, (*_OFTEN, "--set", "realtime.enabled=false"), False, Goal("<=", 2)
    ),
    "an event every 0.5 s": Case(0.5, 15.0, _RARELY, goal=Goal("<=", 1)),
    "an event every 0.5 s, not rehearsed": Case(
        0.5, 15.0, (*_RARELY, "--set", "realtime.rehearse=false"), goal=Goal("<=", 1)
    ),
}


def rows_of(name: str, rounds: Rounds, refused: str) -> list[Row]:
    """Return the rows of a case; ``refused`` are the real-time settings that were not applied."""
    updates, pings = (sum(rounds.of(side, "count")) for side in (OURS, PING))
    note = f"{updates:.0f} updates, {pings:.0f} pings" + (refused and f"; not applied: {refused}")
    return [
        rounds.row(
            f"event → update, {quantile}, {name}", "µs", quantile, OURS, PING, goal,
            note=note if quantile == "p50" else None,
        )
        for quantile, goal in (("p50", CASES[name].goal), ("p99", None))
    ]  # fmt: skip


def _refused(granted: Mapping[str, str]) -> set[str]:
    return {setting for setting, verdict in granted.items() if verdict.startswith("not permitted")}


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both sides in turn, case by case."""
    rounds = {name: Rounds() for name in CASES}
    refused: dict[str, set[str]] = {name: set() for name in CASES}
    for number in range(ROUNDS):
        for name, case in CASES.items():
            say(f"round {number + 1} of {ROUNDS}, {name}")
            bare = ping(round(case.round_s / case.period_s), case.period_s, asked=case.asked)
            rounds[name].add(PING, {"p50": bare.p50_us, "p99": bare.p99_us, "count": bare.received})
            summary = noack(
                "run", "lane_following", "--set", f"horizon_s={case.round_s}",
                *_LOSSLESS, *case.arguments,
            ).summary  # fmt: skip
            found = summary["loops"][0]["latency_us"]
            figures = {"p50": found["p50"], "p99": found["p99"], "count": found["updates"]}
            rounds[name].add(OURS, figures)
            for granted in (bare.granted, *summary["loops"][0]["realtime"].values()):
                refused[name] |= _refused(granted) if case.asked else set()
    return [
        row
        for name, found in rounds.items()
        for row in rows_of(name, found, ", ".join(sorted(refused[name])))
    ]


BENCHMARK = Benchmark("latency", "One-way latency", measure)

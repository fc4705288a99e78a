"""One-way latency from the sensor's event to the controller's update, through netem.

Compared with a bare Python UDP ping through a bare two-socket relay (:mod:`benchmarks._ping`) at
the same period, with the same datagram size and the same real-time settings. Ours also includes the
sensor's trigger test, tagging and checking the datagram, the loss model, the MANSD cap and the
record, on a machine that also runs the plant, the control plane and the recorder. In this scenario
every measurement is an event, so that each run gives thousands of updates.
"""

import argparse
from collections.abc import Mapping

from benchmarks._ping import ping
from benchmarks._report import Benchmark, Goal, Rounds, Row, say
from benchmarks._runs import noack

ROUNDS = 5
ROUND_S = 5.0
PERIOD_S = 0.002
GOALS = {"p50": Goal("<=", 3), "p99": None}
OURS, PING = "noack", "ping through a bare relay"

_EVERY_MEASUREMENT = (
    "run", "lane_following",
    "--set", f"horizon_s={ROUND_S}",
    "--set", "trigger.beta=1e-9",
    "--set", 'network.loss={model="lossless"}',
)  # fmt: skip
_SETTINGS = {"real-time settings": (), "no settings": ("--set", "realtime.enabled=false")}


def rows_of(settings: str, rounds: Rounds, refused: str) -> list[Row]:
    """Return the rows for one choice of real-time settings; ``refused`` are those not applied."""
    updates, pings = (sum(rounds.of(side, "count")) for side in (OURS, PING))
    note = f"{updates:.0f} updates, {pings:.0f} pings" + (refused and f"; not applied: {refused}")
    return [
        rounds.row(
            f"event → update, {quantile}, {settings}", "µs", quantile, OURS, PING, goal,
            note=note if quantile == "p50" else None,
        )
        for quantile, goal in GOALS.items()
    ]  # fmt: skip


def _refused(granted: Mapping[str, str]) -> set[str]:
    return {setting for setting, verdict in granted.items() if verdict.startswith("not permitted")}


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both sides in turn, with and without real-time settings."""
    rounds = {settings: Rounds() for settings in _SETTINGS}
    refused: dict[str, set[str]] = {settings: set() for settings in _SETTINGS}
    for number in range(ROUNDS):
        for settings, arguments in _SETTINGS.items():
            say(f"round {number + 1} of {ROUNDS}, {settings}")
            bare = ping(round(ROUND_S / PERIOD_S), PERIOD_S, asked=not arguments)
            rounds[settings].add(
                PING, {"p50": bare.p50_us, "p99": bare.p99_us, "count": bare.received}
            )
            summary = noack(*_EVERY_MEASUREMENT, *arguments).summary
            found = summary["latency_us"]
            figures = {"p50": found["p50"], "p99": found["p99"], "count": found["updates"]}
            rounds[settings].add(OURS, figures)
            for granted in (bare.granted, *summary["realtime"].values()):
                refused[settings] |= set() if arguments else _refused(granted)
    return [
        row
        for settings, found in rounds.items()
        for row in rows_of(settings, found, ", ".join(sorted(refused[settings])))
    ]


BENCHMARK = Benchmark("latency", "One-way latency", measure)

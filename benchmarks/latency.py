"""One-way latency from the sensor's event to the controller's update, through netem.

Compared with a bare Python UDP ping through a bare two-socket relay (:mod:`benchmarks._ping`) at
the same rhythm, with the same datagram size and the same real-time settings. Ours includes what the
ping lacks: the sensor's trigger test, tagging and checking the datagram, the loss model, the MANSD
cap and the record, on a machine that also runs the plant, the control plane and the recorder. The
scenario makes an event of every measurement, so that each run gives thousands of updates.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks._ping import ping
from benchmarks._report import Benchmark, Goal, Peer, Row, median, run, say
from benchmarks._runs import noack

ROUNDS = 5
ROUND_S = 5.0
PERIOD_S = 0.002
GOAL = Goal("<=", 3)

_EVERY_MEASUREMENT = (
    "run", "lane_following",
    "--set", f"horizon_s={ROUND_S}",
    "--set", "trigger.beta=1e-9",
    "--set", 'network.loss={model="lossless"}',
)  # fmt: skip
_ASKED = {True: "real-time settings", False: "no settings"}
_PLAIN = ("--set", "realtime.enabled=false")


class Sample(NamedTuple):
    """One round's latencies, µs."""

    p50_us: float
    p99_us: float
    size: int


def rows_of(
    settings: str,
    ours: Sequence[Sample],
    pings: Sequence[Sample],
    refused: Sequence[str] = (),
) -> list[Row]:
    """Return the rows for one choice of real-time settings from the rounds of both sides.

    Args:
        settings: name of the choice.
        ours: our rounds.
        pings: the ping's rounds.
        refused: real-time settings that were asked for and refused.
    """
    note = f"{sum(s.size for s in ours)} updates, {sum(s.size for s in pings)} pings"
    if refused:
        note += f"; not permitted: {', '.join(refused)}"
    return [
        Row(
            f"event → update, {quantile}, {settings}",
            median(getattr(sample, f"{quantile}_us") for sample in ours),
            "µs",
            Peer("ping through a bare relay", median(getattr(s, f"{quantile}_us") for s in pings)),
            goal,
            note if quantile == "p50" else None,
        )
        for quantile, goal in (("p50", GOAL), ("p99", None))
    ]


def _refused(granted: Mapping[str, str]) -> set[str]:
    return {setting for setting, verdict in granted.items() if verdict.startswith("not permitted")}


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both sides in turn, with and without real-time settings."""
    ours: dict[bool, list[Sample]] = {asked: [] for asked in _ASKED}
    pings: dict[bool, list[Sample]] = {asked: [] for asked in _ASKED}
    refused: set[str] = set()
    for number in range(ROUNDS):
        for asked, settings in _ASKED.items():
            say(f"round {number + 1} of {ROUNDS}, {settings}")
            bare = ping(round(ROUND_S / PERIOD_S), PERIOD_S, asked=asked)
            pings[asked].append(Sample(bare.p50_us, bare.p99_us, bare.received))
            summary = noack(*_EVERY_MEASUREMENT, *(() if asked else _PLAIN)).summary
            found = summary["latency_us"]
            ours[asked].append(Sample(found["p50"], found["p99"], found["updates"]))
            for granted in (bare.granted, *summary["realtime"].values()):
                refused |= _refused(granted)
    return [
        row
        for asked, settings in _ASKED.items()
        for row in rows_of(settings, ours[asked], pings[asked], sorted(refused) if asked else ())
    ]


BENCHMARK = Benchmark("latency", "One-way latency", measure)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))

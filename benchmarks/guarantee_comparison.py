"""One reordering network without a cap, with a cap on drops only, and with noack's guarantee.

A cap on drops only forces a datagram after m drops, and leaves the delays as they are, as the loss
models of quic-network-simulator and Rattan do. Losses and delays are the same random numbers in all
three. A datagram counts as lost if it is dropped, or if a later one arrives before it.
"""

import argparse
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._loss_check import outcomes_of
from benchmarks._report import Benchmark, Goal, Row
from benchmarks.guarantee import Decider

CAP = 3
LOSS, DELAY = "loss 30%", "delay 10ms 10ms distribution normal reorder 10% limit 1000000"
_SPACING_NS = 2_000_000


def networks() -> dict[str, NDArray[Any]]:
    """Return the decisions of the three networks."""
    free = Decider(f"{LOSS} {DELAY}", _SPACING_NS).decide().copy()
    drops = Decider(f"{LOSS} mansd {CAP}", _SPACING_NS).decide()["release_ns"] < 0
    unlost = Decider(DELAY, _SPACING_NS).decide().copy()
    unlost["release_ns"][drops] = -1
    kept = Decider(f"{LOSS} {DELAY} mansd {CAP}", _SPACING_NS).decide().copy()
    return {
        "no cap": free,
        f"cap {CAP} on drops only": unlost,
        f"mansd {CAP}": kept,
    }


def measure(options: argparse.Namespace) -> list[Row]:
    """Return the losses at the receiver of each network."""
    rows = []
    for name, decisions in networks().items():
        lost, dropped = outcomes_of(decisions), decisions["release_ns"] < 0
        ends = np.flatnonzero(np.concatenate([[True], ~lost, [True]]))
        goal = Goal("<=", CAP) if name.startswith("mansd") else None
        rows += [
            Row(f"{name}: dropped", 100 * float(dropped.mean()), "%"),
            Row(f"{name}: dropped or out of order", 100 * float(lost.mean()), "%"),
            Row(f"{name}: longest loss burst", int(np.diff(ends).max()) - 1, "", goal=goal),
        ]
        if name.startswith("mansd"):
            delay_ns = decisions["hold_back_ns"][decisions["hold_back_ns"] > 0]
            rows.append(Row(f"{name}: held back", 100 * len(delay_ns) / len(lost), "%"))
            rows.append(
                Row(f"{name}: held back by, median", float(np.median(delay_ns)) / 1e6, "ms")
            )
    return rows


BENCHMARK = Benchmark(
    "guarantee_comparison", "Emulator: a reordering network with and without the guarantee", measure
)

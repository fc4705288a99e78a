"""What a relay adds to the one-way delay, and how exactly it keeps a configured delay.

Added delay: sender, relay and sink share a core, datagrams go one by one, back to back, and the
median delay without a relay is subtracted. Our relay asks its loss model for every datagram and
lets all pass (``mansd 0``).

Lateness: a datagram every 0.97 ms through a delay of 10 ms; what its way took beyond that, from the
sender's stamp just before the system call to the kernel's receive stamp at the sink (on one clock),
so that the sink's wake-up has no part in it. Compared with cyclictest on the relay's core.
"""

import argparse
import functools
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np

from benchmarks._relay_cores import BEFORE_OTHERS, LOAD_CORE, RELAY_CORE, on_core, scheduled
from benchmarks._relay_load import Built, Ends, Nanoseconds, built
from benchmarks._relay_ours import Ours
from benchmarks._relay_process import (
    Relay,
    asyncio_relay,
    c_relay,
    in_turn,
    our_relay,
    socat,
    start_all,
)
from benchmarks._report import Benchmark, Goal, MeasurementError, Row, median, run, say
from benchmarks._rounds import Comparison, paired
from benchmarks.lateness import cyclictest

PING_ROUNDS = 60
PINGS = 500
LINE_ROUNDS = 8
LINE_ROUND_S = 2
PERIOD_NS = 970_000
"""Not a divisor of the delay: else each datagram would be due when a later one has just woken the
relay."""
DELAY_MS = 10
FIFO_PRIORITY = 80
"""The usual one for cyclictest."""
_LATENCY = "/dev/cpu_dma_latency"
OURS, DIRECT, KERNEL = "ours", "direct, no relay", "cyclictest"
ADDED = (
    Comparison(OURS, "socat", Goal("<=", 0.75)),
    Comparison(OURS, "C relay"),
    Comparison(OURS, "asyncio relay"),
)
LATENESS = (Comparison(OURS, KERNEL, Goal("<=", 2)), Comparison(OURS, "asyncio relay"))


class Quantiles(NamedTuple):
    """Of a round, µs."""

    p50_us: float
    p99_us: float


def quantiles_of(name: str, delays_ns: Nanoseconds, base_us: float = 0.0) -> Quantiles:
    """Quantiles of the delays beyond ``base_us``.

    Raises:
        MeasurementError: a datagram is missing.
    """
    if lost := int((delays_ns < 0).sum()):
        raise MeasurementError(f"{name}: {lost} of {len(delays_ns)} datagrams did not arrive")
    p50_us, p99_us = np.quantile(delays_ns, [0.5, 0.99]) / 1e3 - base_us
    return Quantiles(float(p50_us), float(p99_us))


Rounds = Mapping[str, Sequence[Quantiles]]


def added_rows(rounds: Rounds, missing: Mapping[str, str]) -> list[Row]:
    """Return the rows of the added delay; only its median has a goal.

    Args:
        rounds: by relay, its rounds; without a relay the one-way delay itself.
        missing: by relay that was not measured, why.
    """
    direct = Row(f"{DIRECT}: one way, p50", median(q.p50_us for q in rounds[DIRECT]), "µs")
    return [direct, *_rows("added one way", ADDED, "p50_us", rounds, missing)]


def lateness_rows(rounds: Rounds, missing: Mapping[str, str], refused: str | None) -> list[Row]:
    """Return the rows of the lateness; only its 99th percentile has a goal.

    Args:
        rounds: by relay, and for cyclictest, their rounds.
        missing: by name of who was not measured, why.
        refused: why the real-time settings cannot be had; then there is nothing to judge.
    """
    if refused is not None:
        missing = {KERNEL: refused, **missing}
    return _rows(f"lateness behind {DELAY_MS} ms", LATENESS, "p99_us", rounds, missing)


def _rows(
    figure: str,
    comparisons: Sequence[Comparison],
    judged: str,
    rounds: Rounds,
    missing: Mapping[str, str],
) -> list[Row]:
    return [
        paired(
            f"{figure}, {quantile.removesuffix('_us')}", "µs",
            comparison if quantile == judged else comparison._replace(goal=None),
            {name: [getattr(found, quantile) for found in of] for name, of in rounds.items()},
            missing,
        )
        for comparison in comparisons for quantile in ("p50_us", "p99_us")
    ]  # fmt: skip


def refusal(fifo: bool) -> str | None:
    """Why the relay does not get the settings that cyclictest takes, if it does not.

    Args:
        fifo: whether the sender got SCHED_FIFO.
    """
    if not fifo:
        return "SCHED_FIFO is refused"
    return None if os.access(_LATENCY, os.W_OK) else f"{_LATENCY} cannot be written"


def _added(relay: Relay, base_us: float) -> Quantiles:
    return quantiles_of(relay.name, relay.ends.ping(PINGS), base_us)


def _late(relay: Relay) -> Quantiles:
    delays_ns = relay.ends.pace(LINE_ROUND_S * 1_000_000_000 // PERIOD_NS, PERIOD_NS)
    return quantiles_of(relay.name, delays_ns, DELAY_MS * 1e3)


def _measure_added(tools: Built) -> list[Row]:
    rounds: dict[str, list[Quantiles]] = {}
    with scheduled(BEFORE_OTHERS), on_core(RELAY_CORE), ExitStack() as stack:
        kinds = {
            "socat": socat(),
            "C relay": c_relay(tools),
            "asyncio relay": asyncio_relay(),
            OURS: our_relay(OURS, Ours("loss 5% mansd 0 seed 7"), lossy=False),
        }
        relays, missing = start_all(kinds, tools, stack)
        direct = Ends(tools.load)
        stack.callback(direct.close)
        direct.connect(direct.sink_port)
        say(f"added delay, {PING_ROUNDS} rounds")
        for _ in range(PING_ROUNDS):
            base = quantiles_of(DIRECT, direct.ping(PINGS))
            rounds.setdefault(DIRECT, []).append(base)
            in_turn(relays, missing, rounds, functools.partial(_added, base_us=base.p50_us))
    return added_rows(rounds, missing)


def _measure_lateness(tools: Built) -> list[Row]:
    rounds: dict[str, list[Quantiles]] = {}
    with on_core(LOAD_CORE), ExitStack() as stack:
        kinds = {
            OURS: our_relay(OURS, Ours(f"delay {DELAY_MS}ms", realtime=True), lossy=False),
            "asyncio relay": asyncio_relay(DELAY_MS),
        }
        relays, missing = start_all(kinds, tools, stack)
        for number in range(LINE_ROUNDS):
            say(f"lateness, round {number + 1} of {LINE_ROUNDS}")
            kernel = cyclictest(LINE_ROUND_S, FIFO_PRIORITY, RELAY_CORE)
            if isinstance(kernel, str):
                missing[KERNEL] = kernel
            else:
                rounds.setdefault(KERNEL, []).append(Quantiles(kernel.p50_us, kernel.p99_us))
            with scheduled(FIFO_PRIORITY) as granted:
                refused = refusal(granted)
                in_turn(relays, missing, rounds, _late)
    return lateness_rows(rounds, missing, refused)


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the added delay, then the lateness of a delay line."""
    with built() as tools:
        return _measure_added(tools) + _measure_lateness(tools)


BENCHMARK = Benchmark("relay_delay", "Relays: delay", measure)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))

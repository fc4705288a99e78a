"""The one-way delay that a relay adds, and the accuracy of a configured delay.

Added delay: sender, relay and sink share a core, datagrams are sent one by one, back to back, and
the median delay without a relay is subtracted. Our relay applies its loss model to every datagram
and forwards all of them (``mansd 0``).

Lateness: a datagram every 0.97 ms, with a delay of 10 ms. Lateness is the excess over this delay,
from the sender's timestamp just before the system call to the kernel's receive timestamp at the
sink (same clock), which excludes the sink's wake-up. Compared with cyclictest on the relay's core.
"""

import argparse
import functools
import os
from contextlib import ExitStack

import numpy as np

from benchmarks import _relay_process as relay_process
from benchmarks._relay_cores import BEFORE_OTHERS, LOAD_CORE, RELAY_CORE, on_core, scheduled
from benchmarks._relay_load import Built, Ends, Nanoseconds, built
from benchmarks._relay_ours import Ours
from benchmarks._report import Benchmark, Figures, Goal, MeasurementError, Rounds, Row, say
from benchmarks.lateness import KERNEL, cyclictest

PING_ROUNDS = 60
PINGS = 500
LINE_ROUNDS = 8
LINE_ROUND_S = 2
PERIOD_NS = 970_000
"""Not a divisor of the delay: else each datagram would be due when the arrival of a later one has
just woken the relay."""
DELAY_MS = 10
FIFO_PRIORITY = 80
"""The usual priority of cyclictest."""
_LATENCY = "/dev/cpu_dma_latency"
OURS, DIRECT = "ours", "direct, no relay"
ADDED_GOALS = {("socat", "p50"): Goal("<=", 0.75), ("C relay", "p50"): Goal("<=", 1.05)}
LATENESS_GOAL = Goal("<=", 2)


def quantiles_of(name: str, delays_ns: Nanoseconds, base_us: float = 0.0) -> Figures:
    """Return quantiles of the delays minus ``base_us``, in µs.

    Raises:
        MeasurementError: a datagram is missing.
    """
    if lost := int((delays_ns < 0).sum()):
        raise MeasurementError(f"{name}: {lost} of {len(delays_ns)} datagrams did not arrive")
    p50_us, p99_us = np.quantile(delays_ns, [0.5, 0.99]) / 1e3 - base_us
    return {"p50": float(p50_us), "p99": float(p99_us)}


def added_rows(rounds: Rounds) -> list[Row]:
    """Return the rows of the added delay; only its median has a goal."""
    return [
        rounds.row(f"{DIRECT}: one way, p50", "µs", "p50", DIRECT),
        *(
            rounds.row(
                f"{OURS}: added one way, {quantile}", "µs", quantile, OURS, peer,
                ADDED_GOALS.get((peer, quantile)), paired=True,
            )
            for peer in ("socat", "C relay") for quantile in ("p50", "p99")
        ),
    ]  # fmt: skip


def lateness_rows(rounds: Rounds) -> list[Row]:
    """Return the rows of the lateness; only its 99th percentile has a goal."""
    name = f"{OURS}: lateness behind {DELAY_MS} ms, {{}}"
    return [
        rounds.row(name.format(quantile), "µs", quantile, OURS, KERNEL, goal, paired=True)
        for quantile, goal in (("p50", None), ("p99", LATENESS_GOAL))
    ]


def refusal(fifo: bool) -> str | None:
    """Return why the relay lacks the settings of cyclictest, or None.

    Args:
        fifo: whether SCHED_FIFO was applied to the sender.
    """
    if not fifo:
        return "SCHED_FIFO is refused"
    return None if os.access(_LATENCY, os.W_OK) else f"{_LATENCY} cannot be written"


def _added(relay: relay_process.Relay, base_us: float) -> Figures:
    return quantiles_of(relay.name, relay.ends.ping(PINGS), base_us)


def _late(relay: relay_process.Relay) -> Figures:
    delays_ns = relay.ends.pace(LINE_ROUND_S * 1_000_000_000 // PERIOD_NS, PERIOD_NS)
    return quantiles_of(relay.name, delays_ns, DELAY_MS * 1e3)


def _measure_added(tools: Built) -> list[Row]:
    rounds = Rounds()
    with scheduled(BEFORE_OTHERS), on_core(RELAY_CORE), ExitStack() as stack:
        kinds = {
            "socat": relay_process.socat(),
            "C relay": relay_process.c_relay(tools),
            OURS: relay_process.our_relay(OURS, Ours("loss 5% mansd 0 seed 7"), lossy=False),
        }
        relays = relay_process.start_all(kinds, tools, stack, rounds)
        direct = Ends(tools.load)
        stack.callback(direct.close)
        direct.connect(direct.sink_port)
        say(f"added delay, {PING_ROUNDS} rounds")
        for _ in range(PING_ROUNDS):
            base = quantiles_of(DIRECT, direct.ping(PINGS))
            rounds.add(DIRECT, base)
            relay_process.in_turn(relays, rounds, functools.partial(_added, base_us=base["p50"]))
    return added_rows(rounds)


def _measure_lateness(tools: Built) -> list[Row]:
    rounds = Rounds()
    with on_core(LOAD_CORE), ExitStack() as stack:
        delayed = Ours(f"delay {DELAY_MS}ms", realtime=True)
        kinds = {OURS: relay_process.our_relay(OURS, delayed, lossy=False)}
        relays = relay_process.start_all(kinds, tools, stack, rounds)
        for number in range(LINE_ROUNDS):
            say(f"lateness, round {number + 1} of {LINE_ROUNDS}")
            rounds.add(KERNEL, cyclictest(LINE_ROUND_S, FIFO_PRIORITY, RELAY_CORE))
            with scheduled(FIFO_PRIORITY) as granted:
                if refused := refusal(granted):
                    rounds.add(KERNEL, refused)
                relay_process.in_turn(relays, rounds, _late)
    return lateness_rows(rounds)


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the added delay, then the lateness of a delay line."""
    with built() as tools:
        return _measure_added(tools) + _measure_lateness(tools)


BENCHMARK = Benchmark("relay_delay", "Relays: delay", measure)

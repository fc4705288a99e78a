"""Datagrams per second through our relay and through others, with Bernoulli loss and MANSD.

A relay is stopped, its receive buffer is filled with thousands of datagrams of 72 bytes, and the
relay is continued. The rate is the number of datagrams received and decided up to the last arrival
at the sink, per second of wall time since the continuation. Hence the sender need not be faster
than the fastest relay, no wake-up is included, and the sink, whose buffer holds the burst, is read
afterwards. The peers forward everything; ours drops some datagrams, which count as decided. Relays
have one core, sender and sink the other. Each round is one burst of each relay, and ratios are the
median over rounds of the ratio within a round.
"""

import argparse
from contextlib import ExitStack
from typing import Literal

from benchmarks import _relay_process as relay_process
from benchmarks._relay_cores import BEFORE_OTHERS, LOAD_CORE, RELAY_CORE, on_core, scheduled
from benchmarks._relay_load import Ends, built
from benchmarks._relay_ours import Ours
from benchmarks._report import Benchmark, Goal, Rounds, Row, say

ROUNDS = 40
WORDS = "loss 5% mansd 4 seed 7"
PLAIN, SEGMENTS = "ours", "ours, segments"
OURS = {
    PLAIN: Ours(WORDS),
    SEGMENTS: Ours(WORDS, segment=True),
}
C_MODES: tuple[tuple[Literal["segment", "names"], ...], ...] = (
    (), ("segment",), ("names",), ("segment", "names"),
)  # fmt: skip
DIRECT = "direct, no relay"
RATES = (
    (PLAIN, "socat", Goal(">=", 2)),
    (PLAIN, "C relay", Goal(">=", 1)),
    (SEGMENTS, "socat", Goal(">=", 5)),
    (PLAIN, DIRECT, None),
    (SEGMENTS, "C relay, segments", Goal(">=", 0.97)),
    (PLAIN, "C relay, senders' addresses", None),
    (SEGMENTS, "C relay, segments, senders' addresses", None),
)
COSTS = (
    (PLAIN, "socat"),
    (PLAIN, "C relay"),
    (PLAIN, DIRECT),
    (SEGMENTS, "C relay, segments"),
)


def rows_of(rounds: Rounds) -> list[Row]:
    """Return the rows of rates and costs."""
    return [
        *(
            rounds.row(f"{ours}: drained", "datagrams/s", "per_s", ours, peer, goal, paired=True)
            for ours, peer, goal in RATES
        ),
        *(
            rounds.row(f"{ours}: cost", "µs CPU each", "cpu_us", ours, peer, paired=True)
            for ours, peer in COSTS
        ),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Send bursts to each relay in turn."""
    rounds = Rounds()
    with built() as tools, on_core(LOAD_CORE), scheduled(BEFORE_OTHERS), ExitStack() as stack:
        kinds = {
            "socat": relay_process.socat(),
            **{kind.name: kind for kind in (relay_process.c_relay(tools, *one) for one in C_MODES)},
            **{name: relay_process.our_relay(name, ours) for name, ours in OURS.items()},
        }
        relays = relay_process.start_all(kinds, tools, stack, rounds)
        direct = Ends(tools.load)
        stack.callback(direct.close)
        direct.connect(direct.sink_port)
        count = min(relay_process.BURST, direct.sink_holds)
        for number in range(ROUNDS):
            if number % 10 == 0:
                say(f"rounds {number + 1} to {number + 10} of {ROUNDS}")
            relay_process.in_turn(relays, rounds, relay_process.Relay.burst)
            with on_core(RELAY_CORE):
                found, cpu_s = direct.direct(count)
            rounds.add(DIRECT, relay_process.figures_of(DIRECT, found, count, 0, cpu_s))
    return rows_of(rounds)


BENCHMARK = Benchmark("relays", "Relays: drained datagrams", measure)

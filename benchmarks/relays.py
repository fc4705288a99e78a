"""Datagrams per second through our relay and through others, with Bernoulli loss and MANSD.

Drained: a relay is stopped, its receive buffer filled with thousands of datagrams of 72 bytes, and
it goes on; the rate is what it has taken in and decided until its last arrival at the sink, per
second of wall time since then. So nobody has to send faster than the fastest relay, nobody waits
for anybody's wake-up, and the sink is read afterwards, where its buffer holds the burst. The peers
forward everything; ours forwards what it does not drop, and the dropped ones count as decided.
Relays have one core, sender and sink the other; each round is one burst of each relay, and ratios
are the median over rounds of the ratio within a round.
"""

import argparse
import operator
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack

from benchmarks._relay_cores import BEFORE_OTHERS, LOAD_CORE, RELAY_CORE, on_core, scheduled
from benchmarks._relay_load import Ends, built
from benchmarks._relay_ours import Ours
from benchmarks._relay_process import (
    BURST,
    Relay,
    Sample,
    asyncio_relay,
    c_relay,
    in_turn,
    our_relay,
    sample_of,
    socat,
    start_all,
)
from benchmarks._report import Benchmark, Goal, Row, run, say
from benchmarks._rounds import Comparison, paired

ROUNDS = 40
WORDS = "loss 5% mansd 4 seed 7"
PLAIN, SEGMENTS, SOCKETS = "ours", "ours, segments", "ours, plain sockets"
OURS = {
    PLAIN: Ours(WORDS),
    SEGMENTS: Ours(WORDS, segment=True),
    SOCKETS: Ours(WORDS, engine="plain"),
}
DIRECT = "direct, no relay"


RATES = (
    Comparison(PLAIN, "socat", Goal(">=", 2)),
    Comparison(PLAIN, "C relay", Goal(">=", 0.8)),
    Comparison(SEGMENTS, "socat", Goal(">=", 5)),
    Comparison(PLAIN, "socat, connected"),
    Comparison(PLAIN, "asyncio relay"),
    Comparison(PLAIN, DIRECT),
    Comparison(SEGMENTS, "C relay, segments"),
    Comparison(SOCKETS, "socat"),
)
COSTS = (
    Comparison(PLAIN, "socat"),
    Comparison(PLAIN, "C relay"),
    Comparison(PLAIN, DIRECT),
    Comparison(SEGMENTS, "C relay, segments"),
    Comparison(SOCKETS, "asyncio relay"),
)


def rows_of(samples: Mapping[str, Sequence[Sample]], missing: Mapping[str, str]) -> list[Row]:
    """Return the rows.

    Args:
        samples: by relay, its bursts, one per round.
        missing: by relay that was not measured, why.
    """
    figures = (
        ("drained", "datagrams/s", RATES, operator.attrgetter("per_s")),
        ("cost", "µs CPU each", COSTS, operator.attrgetter("cpu_us")),
    )
    return [
        paired(
            figure, unit, comparison,
            {name: [value_of(sample) for sample in found] for name, found in samples.items()},
            missing,
        )
        for figure, unit, comparisons, value_of in figures for comparison in comparisons
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Put one burst after the other on each relay in turn."""
    samples: dict[str, list[Sample]] = {}
    with built() as tools, on_core(LOAD_CORE), scheduled(BEFORE_OTHERS), ExitStack() as stack:
        kinds = {
            "socat": socat(),
            "socat, connected": socat(connected=True),
            "C relay": c_relay(tools),
            "C relay, segments": c_relay(tools, segment=True),
            "asyncio relay": asyncio_relay(),
            **{name: our_relay(name, ours) for name, ours in OURS.items()},
        }
        relays, missing = start_all(kinds, tools, stack)
        direct = Ends(tools.load)
        stack.callback(direct.close)
        direct.connect(direct.sink_port)
        count = min(BURST, direct.sink_holds)
        for number in range(ROUNDS):
            if number % 10 == 0:
                say(f"rounds {number + 1} to {number + 10} of {ROUNDS}")
            in_turn(relays, missing, samples, Relay.burst)
            with on_core(RELAY_CORE):
                found, cpu_s = direct.direct(count)
            samples.setdefault(DIRECT, []).append(sample_of(DIRECT, found, count, 0, cpu_s))
    return rows_of(samples, missing)


BENCHMARK = Benchmark("relays", "Relays: drained datagrams", measure)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))

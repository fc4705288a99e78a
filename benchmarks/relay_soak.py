"""A steady load through our relay at half its maximum rate: no unintended loss, constant memory.

Loss is counted at both sides: the relay must receive all sent datagrams, all forwarded datagrams
must arrive at the sink, and at most M − 1 consecutive datagrams may be missing there.
``--soak-s 600`` is the full test.
"""

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks._relay_cores import BEFORE_OTHERS, LOAD_CORE, on_core, scheduled
from benchmarks._relay_load import Built, Soak, built
from benchmarks._relay_ours import Ours, Totals
from benchmarks._relay_process import Relay, our_relay, running
from benchmarks._report import Benchmark, Goal, Peer, Row, median, say

MANSD = 4
KIND = our_relay("ours", Ours(f"loss 5% mansd {MANSD} seed 7"))
MEMORY_GOAL = Goal("<=", 1024)
"""KiB; a leak of two bytes per datagram shows in ten seconds."""
_BURSTS = 15
_GROUP_S = 250e-6
"""Approximate time between two groups of datagrams."""
_LAST_S = 0.1
_STARVED = 0.01


@dataclass(frozen=True)
class Found:
    """Results of a steady load.

    Args:
        maximum_per_s: maximum rate of the relay.
        seconds: duration of the load.
        soak: counts of sender and sink.
        totals: counts of the relay.
        resident_kib: memory of the relay, each second.
        cpu_s: CPU time of the relay.
        waited_s: time in which the relay was ready to run, but other threads had its core.
    """

    maximum_per_s: float
    seconds: float
    soak: Soak
    totals: Totals
    resident_kib: Sequence[float]
    cpu_s: float
    waited_s: float


def growth_kib(resident_kib: Sequence[float]) -> float:
    """Return the growth of memory from the second quarter to the last, without the start-up."""
    quarter = max(len(resident_kib) // 4, 1)
    return median(resident_kib[-quarter:]) - median(resident_kib[quarter : 2 * quarter])


def rows_of(found: Found) -> list[Row]:
    """Return the rows."""
    soak, totals = found.soak, found.totals
    waited = found.waited_s / found.seconds
    none = Goal("==", 0)
    return [
        Row("load", soak.sent / found.seconds, "datagrams/s",
            Peer("drained maximum", found.maximum_per_s), note=f"for {found.seconds:.0f} s"),
        Row("sent but not counted as arrived", soak.sent - totals.arrived, "datagrams", goal=none),
        Row("forwarded but not received", totals.forwarded - soak.received, "datagrams", goal=none),
        Row("lost in the relay's receive buffer", totals.lost_in_kernel, "datagrams", goal=none),
        Row("longest loss burst", soak.longest_gap, "datagrams", goal=Goal("<=", MANSD)),
        Row("received out of order", soak.disordered, "datagrams", goal=none),
        Row("memory, last quarter beyond second", growth_kib(found.resident_kib), "KiB",
            goal=MEMORY_GOAL, note=f"of {found.resident_kib[-1] / 1024:.0f} MiB"),
        Row("CPU of the relay", 100 * found.cpu_s / found.seconds, "% of a core"),
        Row("the relay waited for its core", 100 * waited, "% of the time",
            note="others had its core: a loss may be theirs" if waited > _STARVED else None),
    ]  # fmt: skip


def _resident_kib(relay: Relay) -> float:
    pages = int(Path(f"/proc/{relay.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024


def groups(per_s: float) -> tuple[int, int]:
    """Return the size of a group and the time between two groups, ns, for a rate."""
    size = max(round(per_s * _GROUP_S), 1)
    return size, round(size / per_s * 1e9)


def _soak(tools: Built, seconds: int, maximum_per_s: float) -> Found:
    group, period_ns = groups(maximum_per_s / 2)
    groups_per_s = round(1e9 / period_ns)
    state, resident_kib = Soak(), list[float]()
    with running(KIND, tools) as relay:
        begun_s, begun_cpu_s, begun_waited_s = time.monotonic(), relay.cpu_s(), relay.waited_s()
        for number in range(seconds):
            if number % 60 == 0:
                say(f"{group * groups_per_s:,} datagrams/s, {number} of {seconds} s")
            relay.ends.soak(state, groups_per_s, group, period_ns)
            resident_kib.append(_resident_kib(relay))
        elapsed_s, cpu_s = time.monotonic() - begun_s, relay.cpu_s() - begun_cpu_s
        waited_s = relay.waited_s() - begun_waited_s
        # Empty groups: receive the datagrams still in flight.
        relay.ends.soak(state, round(_LAST_S / _GROUP_S), 0, period_ns)
        return Found(maximum_per_s, elapsed_s, state, relay.totals(), resident_kib, cpu_s, waited_s)


def measure(options: argparse.Namespace) -> list[Row]:
    """Find the maximum rate, then load a new relay with half of it."""
    with built() as tools, on_core(LOAD_CORE), scheduled(BEFORE_OTHERS):
        with running(KIND, tools) as relay:
            maximum_per_s = median([relay.burst()["per_s"] for _ in range(_BURSTS)])
        return rows_of(_soak(tools, options.soak_s, maximum_per_s))


def _seconds(text: str) -> int:
    seconds = int(text)
    if seconds < 4:
        raise argparse.ArgumentTypeError("must be 4 or more")
    return seconds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the duration of the load."""
    parser.add_argument(
        "--soak-s",
        type=_seconds,
        default=20,
        metavar="S",
        help="length of relay_soak (%(default)s)",
    )


BENCHMARK = Benchmark("relay_soak", "Our relay under a steady load", measure, add_arguments)

"""Relays, ours (``python -m netem``) and others, under load.

``relays`` and ``relay_flows``: a relay is stopped, its receive buffer is filled with thousands of
datagrams of 72 bytes, and the relay is continued. The rate is the number of datagrams received and
decided up to the last arrival at the sink, per second of wall time since the continuation. Hence
the sender need not be faster than the fastest relay, no wake-up is included, and the sink, whose
buffer holds the burst, is read afterwards. The peers forward everything; ours drops some datagrams,
which count as decided. Relays have one core, sender and sink the other. Each round is one burst of
each relay, and ratios are the median over rounds of the ratio within a round.
"""

import argparse
import os
import time
from collections.abc import Iterator
from functools import partial

import psutil

from benchmarks import relay_load
from benchmarks.cases.latency import KERNEL, cyclictest
from benchmarks.programs import LOAD_CORE, RELAY_CORE, on_core, raise_priority
from benchmarks.report import (
    ZERO,
    Figures,
    Goal,
    MeasurementError,
    Peer,
    Rounds,
    Row,
    announce,
    benchmark,
    median,
    option,
    quantiles_us,
)

ROUNDS = 2
WORDS = "loss 5% mansd 4 seed 7"
PLAIN, SEGMENTS, DIRECT = "ours", "ours, segments", "direct, no relay"
REVERSE = "ours, with the reverse direction"
C_MODES = ((), ("segment",), ("names",), ("segment", "names"))
RATES = (
    (PLAIN, "socat", Goal(">=", 2)),
    (PLAIN, "C relay", Goal(">=", 1)),
    (SEGMENTS, "socat", Goal(">=", 5)),
    (SEGMENTS, "C relay, segments", Goal(">=", 0.97)),
    (PLAIN, "C relay, senders' addresses", None),
    (SEGMENTS, "C relay, segments, senders' addresses", None),
)


@benchmark("relays", "Relays: drained datagrams")
def drained(options: argparse.Namespace) -> Iterator[Row]:
    """Send bursts to each relay in turn; yield rates and costs."""
    with relay_load.compiled_code() as tools, on_core(LOAD_CORE), raise_priority():
        ours = relay_load.our_relay(PLAIN, WORDS), relay_load.our_relay(SEGMENTS, WORDS, "--segment")
        kinds = relay_load.socat(), *(relay_load.c_relay(tools, *modes) for modes in C_MODES), *ours
        with relay_load.started(kinds, tools) as (rounds, relays):
            rounds.measure_in_turn(ROUNDS, {relay.name: relay.burst for relay in relays})
    for side, peer, goal in RATES:
        yield rounds.row(f"{side}: drained", "datagrams/s", "per_s", side, peer, goal, paired=True)
    for peer in ("socat", "C relay"):
        yield rounds.row(f"{PLAIN}: cost", "µs CPU each", "cpu_us", PLAIN, peer, paired=True)


FLOW_ROUNDS, FLOWS = 2, 10_000
PATHS = "C relay, a socket per client"


@benchmark("relay_flows", "Relays: flows")
def flows(options: argparse.Namespace) -> Iterator[Row]:
    """Send bursts from ten thousand addresses and from one to each relay in turn.

    The cost is the relay's CPU time per datagram while it empties a full receive buffer. The C
    relay, which ignores addresses, shows the kernel's share of it; with a socket per client, it
    does what our relay with the reverse direction does: it also waits for answers at all sockets
    and returns them. (To wait for a socket by epoll costs when sending, too.)
    """
    single, many = relay_load.sources(1), relay_load.sources(FLOWS)
    with relay_load.compiled_code() as tools, on_core(LOAD_CORE), raise_priority():
        kinds = (
            relay_load.c_relay(tools),
            relay_load.c_relay(tools, "paths"),
            relay_load.our_relay(PLAIN, WORDS),
            relay_load.our_relay(REVERSE, WORDS, reverse=True),
        )
        with relay_load.started(kinds, tools) as (rounds, relays):
            for relay in relays:
                relay.burst(many)  # makes the states of the flows; not counted
            loads = (_single, single), (_many, many)
            sides = {name(relay.name): partial(relay.burst, to) for relay in relays for name, to in loads}
            rounds.measure_in_turn(FLOW_ROUNDS, sides)
            for name, reason in list(rounds.missing.items()):
                rounds.add(_many(name), reason)
    cases = [
        (name, _single(name), Goal("<=", 1.3) if name in (PLAIN, REVERSE) else None)
        for name in (PLAIN, REVERSE, "C relay", PATHS)
    ]
    for name, peer, goal in (*cases, (REVERSE, _many(PATHS), Goal("<=", 1))):
        whole = _many(name)
        yield rounds.row(f"{whole}: cost", "µs CPU each", "cpu_us", whole, peer, goal, paired=True)


def _single(name: str) -> str:
    return f"{name}, one flow"


def _many(name: str) -> str:
    return f"{name}, {FLOWS:,} flows"


PING_ROUNDS, PINGS = 2, 500
LINE_ROUNDS, LINE_ROUND_S = 1, 2
PERIOD_NS = 970_000
"""Not a divisor of the delay: else each datagram would be due when the arrival of a later one has
just woken the relay."""
DELAY_MS = 10
FIFO_PRIORITY = 80
"""The usual priority of cyclictest."""
_LATENCY = "/dev/cpu_dma_latency"
ADDED_GOALS = {("socat", "p50"): Goal("<=", 0.75), ("C relay", "p50"): Goal("<=", 1.05)}


@benchmark("relay_delay", "Relays: delay")
def delay(options: argparse.Namespace) -> Iterator[Row]:
    """Measure the one-way delay that a relay adds, and the accuracy of a configured delay.

    Added delay: sender, relay and sink share a core, datagrams are sent one by one, back to back,
    and the median delay without a relay is subtracted. Our relay applies its loss model to every
    datagram and forwards all of them (``mansd 0``).

    Lateness: a datagram every 0.97 ms, with a delay of 10 ms. Lateness is the excess over this
    delay, from the sender's timestamp just before the system call to the kernel's receive timestamp
    at the sink (same clock), which excludes the sink's wake-up. Compared with cyclictest on the
    relay's core.
    """
    with relay_load.compiled_code() as tools:
        added_rounds, late_rounds = _added(tools), _late(tools)
    yield added_rounds.row(f"{DIRECT}: one way, p50", "µs", "p50", DIRECT)
    for peer in ("socat", "C relay"):
        for quantile in ("p50", "p99"):
            name, goal = f"{PLAIN}: added one way, {quantile}", ADDED_GOALS.get((peer, quantile))
            yield added_rounds.row(name, "µs", quantile, PLAIN, peer, goal, paired=True)
    for quantile, goal in (("p50", None), ("p99", Goal("<=", 2))):
        name = f"{PLAIN}: lateness behind {DELAY_MS} ms, {quantile}"
        yield late_rounds.row(name, "µs", quantile, PLAIN, KERNEL, goal, paired=True)


def quantiles_of(name: str, delays_ns: relay_load.Nanoseconds, base_us: float = 0.0) -> Figures:
    """Return quantiles of the delays minus ``base_us``, in µs."""
    if lost := int((delays_ns < 0).sum()):
        raise MeasurementError(f"{name}: {lost} of {len(delays_ns)} datagrams did not arrive")
    return quantiles_us(delays_ns - 1e3 * base_us)


def _added(tools: relay_load.CompiledCode) -> Rounds:
    ours = relay_load.our_relay(PLAIN, "loss 5% mansd 0 seed 7", lossy=False)
    base_us = 0.0

    def added(relay: relay_load.LoadedRelay) -> Figures:
        return quantiles_of(relay.name, relay.ends.ping(PINGS), base_us)

    def base() -> Figures:
        nonlocal base_us
        delays = quantiles_of(DIRECT, direct.ping(PINGS))
        base_us = delays["p50"]
        return delays

    with (
        raise_priority(),
        on_core(RELAY_CORE),
        relay_load.direct_ends(tools) as direct,
        relay_load.started((relay_load.socat(), relay_load.c_relay(tools), ours), tools) as (rounds, relays),
    ):
        sides = {DIRECT: base} | {relay.name: partial(added, relay) for relay in relays}
        rounds.measure_in_turn(PING_ROUNDS, sides, "added delay, ")
    return rounds


def _late(tools: relay_load.CompiledCode) -> Rounds:
    def kernel() -> Figures:
        if not os.access(_LATENCY, os.W_OK):
            raise MeasurementError(f"{_LATENCY} cannot be written")
        return cyclictest(LINE_ROUND_S, FIFO_PRIORITY, RELAY_CORE)

    def late(relay: relay_load.LoadedRelay) -> Figures:
        with raise_priority(FIFO_PRIORITY) as permitted:
            if not permitted:
                rounds.add(KERNEL, "SCHED_FIFO is refused")
            delays_ns = relay.ends.pace(LINE_ROUND_S * 1_000_000_000 // PERIOD_NS, PERIOD_NS)
        return quantiles_of(relay.name, delays_ns, DELAY_MS * 1e3)

    delayed = relay_load.our_relay(PLAIN, f"delay {DELAY_MS}ms", "--realtime", lossy=False)
    with on_core(LOAD_CORE), relay_load.started([delayed], tools) as (rounds, relays):
        sides = {KERNEL: kernel} | {relay.name: partial(late, relay) for relay in relays}
        rounds.measure_in_turn(LINE_ROUNDS, sides, "lateness, ")
    return rounds


MANSD = 4
MEMORY_GOAL = Goal("<=", 1024)
"""KiB; a leak of two bytes per datagram shows in ten seconds."""
_BURSTS = 15
_GROUP_S = 250e-6
"""Approximate time between two groups of datagrams."""
_LAST_S = 0.1


@benchmark(
    "relay_soak",
    "Our relay under a steady load",
    {"--soak-s": option(20, "length of relay_soak, at least 4 s")},
)
def steady_load(options: argparse.Namespace) -> Iterator[Row]:
    """Load our relay with half its maximum rate: no unintended loss, constant memory.

    Loss is counted at both sides: the relay must receive all sent datagrams, all forwarded
    datagrams must arrive at the sink, and at most M − 1 consecutive datagrams may be missing there.
    ``--soak-s 600`` is the full test.
    """
    kind = relay_load.our_relay(PLAIN, f"loss 5% mansd {MANSD} seed 7")
    with relay_load.compiled_code() as tools, on_core(LOAD_CORE), raise_priority():
        with relay_load.running(kind, tools) as relay:
            maximum_per_s = median([relay.burst()["per_s"] for _ in range(_BURSTS)])
        with relay_load.running(kind, tools) as relay:
            yield from _soak_rows(relay, options.soak_s, maximum_per_s)


def _soak_rows(relay: relay_load.LoadedRelay, seconds: int, maximum_per_s: float) -> Iterator[Row]:
    """Load a relay with half of its maximum rate, in groups of datagrams; yield the rows."""
    group = max(round(maximum_per_s / 2 * _GROUP_S), 1)
    period_ns = round(group / (maximum_per_s / 2) * 1e9)
    groups_per_s = round(1e9 / period_ns)
    counts, resident_kib = relay_load.new_soak(), list[float]()
    began_s = time.monotonic()
    for number in range(seconds):
        if number % 60 == 0:
            announce(f"{group * groups_per_s:,} datagrams/s, {number} of {seconds} s")
        relay.ends.soak(counts, groups_per_s, group, period_ns)
        resident_kib.append(psutil.Process(relay.pid).memory_info().rss / 1024)
    elapsed_s = time.monotonic() - began_s
    # Empty groups: receive the datagrams still in flight.
    relay.ends.soak(counts, round(_LAST_S / _GROUP_S), 0, period_ns)
    totals, quarter = relay.totals(), max(seconds // 4, 1)
    growth_kib = median(resident_kib[-quarter:]) - median(resident_kib[quarter : 2 * quarter])
    peer, note = Peer("drained maximum", maximum_per_s), f"for {elapsed_s:.0f} s"
    yield Row("load", counts.sent / elapsed_s, "datagrams/s", peer, note=note)
    for name, number in (
        ("sent but not counted as arrived", counts.sent - totals["received"]),
        ("forwarded but not received", totals["forwarded"] - counts.received),
        ("lost in the relay's receive buffer", totals["lost_in_kernel"]),
        ("received out of order", counts.disordered),
    ):
        yield Row(name, number, "datagrams", goal=ZERO)
    yield Row("longest loss burst", counts.longest_gap, "datagrams", goal=Goal("<=", MANSD))
    note = f"of {resident_kib[-1] / 1024:.0f} MiB"
    yield Row("memory, last quarter beyond second", growth_kib, "KiB", goal=MEMORY_GOAL, note=note)

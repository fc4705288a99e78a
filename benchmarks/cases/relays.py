"""Relays, ours (``python -m netem``) and others, under load.

``relays`` and ``relay_flows``: a relay is stopped, its receive buffer is filled with thousands of
datagrams, and the relay is continued. The rate is the number of datagrams received and decided up
to the last arrival at the sink, per second of wall time since the continuation. The peers forward
everything; ours drops some datagrams, which count as decided. Each round is one burst of each
relay, and ratios are the median over rounds of the ratio within a round.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial

from benchmarks import relay_load
from benchmarks.cases.latency import KERNEL, cyclictest
from benchmarks.programs import LOAD_CORE, RELAY_CORE, on_core
from benchmarks.relay_load import SOCAT, LoadedRelay, c_relay, our_relay
from benchmarks.report import Goal, MeasurementError, Row, benchmark
from benchmarks.rounds import Figures, Rounds, quantiles_us

ROUNDS = 9
WORDS = "loss 5% mansd 4 seed 7"
PLAIN, SEGMENTS = "ours", "ours, segments"
REVERSE = "ours, with the reverse direction"
RATES = (
    (PLAIN, "socat", Goal(">=", 2)),
    (PLAIN, "C relay", Goal(">=", 0.97)),
    (SEGMENTS, "socat", Goal(">=", 5)),
    (SEGMENTS, "C relay, segments", Goal(">=", 1)),
    (PLAIN, "C relay, senders' addresses", None),
    (SEGMENTS, "C relay, segments, senders' addresses", None),
)


@benchmark("relays", "Relays: drained datagrams")
def drained() -> Iterator[Row]:
    """Send bursts to each relay in turn; yield rates and costs."""
    ours = our_relay(PLAIN, f"{WORDS} --one-way"), our_relay(SEGMENTS, f"{WORDS} --one-way --segment")
    peers = SOCAT, c_relay(), c_relay("segment"), c_relay("names"), c_relay("segment", "names")
    with relay_load.started(*peers, *ours) as (rounds, relays), on_core(LOAD_CORE):
        rounds.measure_in_turn(ROUNDS, {name: relay.burst for name, relay in relays.items()})
    for side, peer, goal in RATES:
        yield rounds.row(f"{side}: drained", "datagrams/s", "per_s", side, peer, goal, paired=True)
    yield rounds.row(f"{PLAIN}: cost", "µs CPU each", "cpu_us", PLAIN, "C relay", paired=True)


FLOW_ROUNDS, FLOWS = 3, 10_000
PATHS = "C relay, a socket per client"
ONE_FLOW, ALL = ", one flow", f", {FLOWS:,} flows"


@benchmark("relay_flows", "Relays: flows")
def flows() -> Iterator[Row]:
    """Send bursts from ten thousand addresses and from one to each relay in turn.

    The C relay, which ignores addresses, shows the kernel's share of the cost; with a socket per
    client, it does what our relay with the reverse direction does: it also waits for answers at all
    sockets and returns them. (To wait for a socket by epoll costs when sending, too.)
    """
    single, many = relay_load.sources(1), relay_load.sources(FLOWS)
    kinds = c_relay(), c_relay("paths"), our_relay(PLAIN, f"{WORDS} --one-way"), our_relay(REVERSE, WORDS)
    with relay_load.started(*kinds) as (rounds, relays), on_core(LOAD_CORE):
        sides = dict[str, Callable[[], Figures]]()
        for name, relay in relays.items():
            relay.burst(many)  # makes the states of the flows; not counted
            sides |= {name + ONE_FLOW: partial(relay.burst, single), name + ALL: partial(relay.burst, many)}
        rounds.measure_in_turn(FLOW_ROUNDS, sides)
    rounds.missing |= {name + ALL: reason for name, reason in rounds.missing.items()}
    goals = {PLAIN: Goal("<=", 1.3), REVERSE: Goal("<=", 1.3), "C relay": None, PATHS: None}
    cases = [(name, name + ONE_FLOW, goal) for name, goal in goals.items()]
    for name, peer, goal in (*cases, (REVERSE, PATHS + ALL, Goal("<=", 1))):
        yield rounds.row(f"{name}{ALL}: cost", "µs CPU each", "cpu_us", name + ALL, peer, goal, paired=True)


PING_ROUNDS, PINGS = 5, 500
LINE_ROUNDS, LINE_ROUND_S = 5, 2
PERIOD_NS = 970_000
"""Not a divisor of the delay: else each datagram would be due when the arrival of a later one has
just woken the relay."""
DELAY_MS = 10
FIFO_PRIORITY = 80
"""The usual priority of cyclictest."""
_LATENCY = "/dev/cpu_dma_latency"


@benchmark("relay_delay", "Relays: delay")
def delay() -> Iterator[Row]:
    """Measure the one-way delay that a relay adds, and the accuracy of a configured delay.

    Added delay: sender, relay and sink share a core, datagrams are sent one by one, and the median
    delay without a relay is subtracted. Our relay applies its loss model to every datagram and
    forwards all of them (``mansd 0``).

    Lateness is the excess over a delay of 10 ms, from the sender's timestamp just before the system
    call to the kernel's receive timestamp at the sink (same clock), which excludes the sink's
    wake-up. Compared with cyclictest on the relay's core.
    """
    added_rounds, late_rounds = _added(), _late()
    for peer, limit in (("socat", 0.75), ("C relay", 1.05)):
        name, goal = f"{PLAIN}: added one way, p50", Goal("<=", limit)
        yield added_rounds.row(name, "µs", "p50", PLAIN, peer, goal, paired=True)
    for quantile, late_goal in (("p50", None), ("p99", Goal("<=", 0.5))):
        name = f"{PLAIN}: lateness behind {DELAY_MS} ms, {quantile}"
        yield late_rounds.row(name, "µs", quantile, PLAIN, KERNEL, late_goal, paired=True)


def _quantiles(delays_ns: relay_load.Nanoseconds, base_us: float = 0.0) -> Figures:
    """Return quantiles of the delays minus ``base_us``, in µs."""
    if lost := int((delays_ns < 0).sum()):
        raise MeasurementError(f"{lost} of {len(delays_ns)} datagrams did not arrive")
    return quantiles_us(delays_ns - 1e3 * base_us)


def _added() -> Rounds:
    def added(relay: LoadedRelay) -> Figures:
        base_us = _quantiles(direct.delays_ns(PINGS))["p50"]
        return _quantiles(relay.ends.delays_ns(PINGS), base_us)

    ours = our_relay(PLAIN, "loss 5% mansd 0 seed 7 --one-way", lossy=False)
    with (
        closing(relay_load.PathEnds()) as direct,
        relay_load.started(SOCAT, c_relay(), ours) as (rounds, relays),
        on_core(RELAY_CORE),
    ):
        direct.out.connect(direct.sink.getsockname())
        sides = {name: partial(added, relay) for name, relay in relays.items()}
        rounds.measure_in_turn(PING_ROUNDS, sides, "added delay, ")
    return rounds


def _late() -> Rounds:
    def kernel() -> Figures:
        if not os.access(_LATENCY, os.W_OK):
            raise MeasurementError(f"{_LATENCY} cannot be written")
        return cyclictest(LINE_ROUND_S, FIFO_PRIORITY, RELAY_CORE)

    def late(relay: LoadedRelay) -> Figures:
        with on_core(LOAD_CORE, FIFO_PRIORITY) as permitted:
            if not permitted:
                rounds.missing[KERNEL] = "SCHED_FIFO is refused"
            delays_ns = relay.ends.delays_ns(LINE_ROUND_S * 1_000_000_000 // PERIOD_NS, PERIOD_NS)
        return _quantiles(delays_ns, DELAY_MS * 1e3)

    delayed = our_relay(PLAIN, f"delay {DELAY_MS}ms --one-way --realtime", lossy=False)
    with relay_load.started(delayed) as (rounds, relays):
        sides = {KERNEL: kernel} | {name: partial(late, relay) for name, relay in relays.items()}
        rounds.measure_in_turn(LINE_ROUNDS, sides, "lateness, ")
    return rounds

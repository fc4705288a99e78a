"""Relays, ours (``python -m netem``) and others, under load; and a shell beside others.

``relays`` and ``relay_flows``: a relay is stopped, its receive buffer is filled with thousands of
datagrams of 72 bytes, and the relay is continued. The rate is the number of datagrams received and
decided up to the last arrival at the sink, per second of wall time since the continuation. Hence
the sender need not be faster than the fastest relay, no wake-up is included, and the sink, whose
buffer holds the burst, is read afterwards. The peers forward everything; ours drops some datagrams,
which count as decided. Relays have one core, sender and sink the other. Each round is one burst of
each relay, and ratios are the median over rounds of the ratio within a round.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import psutil

from benchmarks.latency import KERNEL, cyclictest
from benchmarks.programs import BEFORE_OTHERS, LOAD_CORE, RELAY_CORE, compiled, on_core, scheduled
from benchmarks.relay_load import (
    BURST,
    Built,
    Nanoseconds,
    Relay,
    Sides,
    built,
    c_relay,
    figures_of,
    new_soak,
    our_relay,
    running,
    socat,
    sources,
)
from benchmarks.report import Figures, Goal, MeasurementError, Peer, Rounds, Row, benchmark, median, say
from netem.relay_links import LinkSpec
from netem.shell.devices import open_devices
from noack.impairments.link_settings import LinkSettings

ROUNDS = 2
WORDS = "loss 5% mansd 4 seed 7"
PLAIN, SEGMENTS, DIRECT = "ours", "ours, segments", "direct, no relay"
REVERSE = "ours, with the reverse direction"
C_MODES = ((), ("segment",), ("names",), ("segment", "names"))
RATES = (
    (PLAIN, "socat", Goal(">=", 2)),
    (PLAIN, "C relay", Goal(">=", 1)),
    (SEGMENTS, "socat", Goal(">=", 5)),
    (PLAIN, DIRECT, None),
    (SEGMENTS, "C relay, segments", Goal(">=", 0.97)),
    (PLAIN, "C relay, senders' addresses", None),
    (SEGMENTS, "C relay, segments, senders' addresses", None),
)
COSTS = ((PLAIN, "socat"), (PLAIN, "C relay"), (PLAIN, DIRECT), (SEGMENTS, "C relay, segments"))


@benchmark("relays", "Relays: drained datagrams")
def drained(options: argparse.Namespace) -> Iterator[Row]:
    """Send bursts to each relay in turn."""
    with built() as tools, on_core(LOAD_CORE), scheduled(BEFORE_OTHERS):
        kinds = [c_relay(tools, *one) for one in C_MODES] + [
            our_relay(PLAIN, WORDS),
            our_relay(SEGMENTS, WORDS, "--segment"),
        ]
        named = [("socat", socat()), *((kind.name, kind) for kind in kinds)]
        with Sides(named, tools) as sides:
            direct = sides.direct()
            count = min(BURST, direct.sink_holds)
            for number in range(ROUNDS):
                if number % 10 == 0:
                    say(f"rounds {number + 1} to {number + 10} of {ROUNDS}")
                sides.in_turn(lambda relay: {relay.name: relay.burst()})
                with on_core(RELAY_CORE):
                    found, cpu_s = direct.direct(count)
                sides.rounds.add(DIRECT, figures_of(DIRECT, found, count, 0, cpu_s))
    yield from rows_of(sides.rounds)


def rows_of(rounds: Rounds) -> Iterator[Row]:
    """Yield the rows of rates and costs."""
    for ours, peer, goal in RATES:
        yield rounds.row(f"{ours}: drained", "datagrams/s", "per_s", ours, peer, goal, paired=True)
    for ours, peer in COSTS:
        yield rounds.row(f"{ours}: cost", "µs CPU each", "cpu_us", ours, peer, paired=True)


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
    with built() as tools, on_core(LOAD_CORE), scheduled(BEFORE_OTHERS):
        kinds = [
            c_relay(tools),
            c_relay(tools, "paths"),
            our_relay(PLAIN, WORDS),
            our_relay(REVERSE, WORDS, reverse=True),
        ]
        with Sides([(kind.name, kind) for kind in kinds], tools) as sides:
            one, many = sources(1), sources(FLOWS)

            def costs(relay: Relay) -> Mapping[str, Figures]:
                single, all_flows = relay.burst(one), relay.burst(many)
                return {_single(relay.name): single, _many(relay.name): all_flows}

            def begin(relay: Relay) -> Mapping[str, Figures]:
                costs(relay)  # makes the states of the flows; not counted
                return {}

            sides.in_turn(begin)
            for number in range(FLOW_ROUNDS):
                if number % 10 == 0:
                    say(f"rounds {number + 1} to {number + 10} of {FLOW_ROUNDS}")
                sides.in_turn(costs)
    yield from flow_rows(sides.rounds)


def _single(name: str) -> str:
    return f"{name}, one flow"


def _many(name: str) -> str:
    return f"{name}, {FLOWS:,} flows"


def flow_rows(rounds: Rounds) -> Iterator[Row]:
    """Yield the rows of the relays: the cost of many flows compared with the cost of one."""
    cases = [
        (name, _single(name), Goal("<=", 1.3) if name in (PLAIN, REVERSE) else None)
        for name in (PLAIN, REVERSE, "C relay", PATHS)
    ]
    for name, peer, goal in (*cases, (REVERSE, _many(PATHS), Goal("<=", 1))):
        if name in rounds.missing:
            rounds.add(_many(name), rounds.missing[name])
        yield rounds.row(
            f"{_many(name)}: cost", "µs CPU each", "cpu_us", _many(name), peer, goal, paired=True
        )


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
    with built() as tools:
        yield from added_rows(_added(tools))
        yield from lateness_rows(_late(tools))


def quantiles_of(name: str, delays_ns: Nanoseconds, base_us: float = 0.0) -> Figures:
    """Return quantiles of the delays minus ``base_us``, in µs.

    Raises:
        MeasurementError: a datagram is missing.
    """
    if lost := int((delays_ns < 0).sum()):
        raise MeasurementError(f"{name}: {lost} of {len(delays_ns)} datagrams did not arrive")
    p50_us, p99_us = np.quantile(delays_ns, [0.5, 0.99]) / 1e3 - base_us
    return {"p50": float(p50_us), "p99": float(p99_us)}


def _added(tools: Built) -> Rounds:
    ours = our_relay(PLAIN, "loss 5% mansd 0 seed 7", lossy=False)
    named = [("socat", socat()), ("C relay", c_relay(tools)), (PLAIN, ours)]
    with scheduled(BEFORE_OTHERS), on_core(RELAY_CORE), Sides(named, tools) as sides:
        direct = sides.direct()
        say(f"added delay, {PING_ROUNDS} rounds")
        for _ in range(PING_ROUNDS):
            base = quantiles_of(DIRECT, direct.ping(PINGS))
            sides.rounds.add(DIRECT, base)
            sides.in_turn(
                lambda relay, base_us=base["p50"]: {
                    relay.name: quantiles_of(relay.name, relay.ends.ping(PINGS), base_us)
                }
            )
    return sides.rounds


def _late(tools: Built) -> Rounds:
    delayed = our_relay(PLAIN, f"delay {DELAY_MS}ms", "--realtime", lossy=False)

    def late(relay: Relay) -> Mapping[str, Figures]:
        delays_ns = relay.ends.pace(LINE_ROUND_S * 1_000_000_000 // PERIOD_NS, PERIOD_NS)
        return {relay.name: quantiles_of(relay.name, delays_ns, DELAY_MS * 1e3)}

    with on_core(LOAD_CORE), Sides([(PLAIN, delayed)], tools) as sides:
        for number in range(LINE_ROUNDS):
            say(f"lateness, round {number + 1} of {LINE_ROUNDS}")
            sides.rounds.add(KERNEL, cyclictest(LINE_ROUND_S, FIFO_PRIORITY, RELAY_CORE))
            with scheduled(FIFO_PRIORITY) as permitted:
                if not permitted:
                    sides.rounds.add(KERNEL, "SCHED_FIFO is refused")
                elif not os.access(_LATENCY, os.W_OK):
                    sides.rounds.add(KERNEL, f"{_LATENCY} cannot be written")
                sides.in_turn(late)
    return sides.rounds


def added_rows(rounds: Rounds) -> Iterator[Row]:
    """Yield the rows of the added delay; only its median has a goal."""
    yield rounds.row(f"{DIRECT}: one way, p50", "µs", "p50", DIRECT)
    for peer in ("socat", "C relay"):
        for quantile in ("p50", "p99"):
            name, goal = f"{PLAIN}: added one way, {quantile}", ADDED_GOALS.get((peer, quantile))
            yield rounds.row(name, "µs", quantile, PLAIN, peer, goal, paired=True)


def lateness_rows(rounds: Rounds) -> Iterator[Row]:
    """Yield the rows of the lateness; only its 99th percentile has a goal."""
    for quantile, goal in (("p50", None), ("p99", Goal("<=", 2))):
        name = f"{PLAIN}: lateness behind {DELAY_MS} ms, {quantile}"
        yield rounds.row(name, "µs", quantile, PLAIN, KERNEL, goal, paired=True)


MANSD = 4
MEMORY_GOAL = Goal("<=", 1024)
"""KiB; a leak of two bytes per datagram shows in ten seconds."""
_BURSTS = 15
_GROUP_S = 250e-6
"""Approximate time between two groups of datagrams."""
_LAST_S = 0.1
_STARVED = 0.01


def _seconds(text: str) -> int:
    if (seconds := int(text)) < 4:
        raise argparse.ArgumentTypeError("must be 4 or more")
    return seconds


@benchmark(
    "relay_soak",
    "Our relay under a steady load",
    {
        "--soak-s": {
            "type": _seconds,
            "default": 20,
            "metavar": "S",
            "help": "length of relay_soak (%(default)s)",
        }
    },
)
def steady_load(options: argparse.Namespace) -> Iterator[Row]:
    """Load our relay with half its maximum rate: no unintended loss, constant memory.

    Loss is counted at both sides: the relay must receive all sent datagrams, all forwarded
    datagrams must arrive at the sink, and at most M − 1 consecutive datagrams may be missing there.
    ``--soak-s 600`` is the full test.
    """
    kind = our_relay(PLAIN, f"loss 5% mansd {MANSD} seed 7")
    with built() as tools, on_core(LOAD_CORE), scheduled(BEFORE_OTHERS):
        with running(kind, tools) as relay:
            maximum_per_s = median([relay.burst()["per_s"] for _ in range(_BURSTS)])
        with running(kind, tools) as relay:
            yield from _soak_rows(relay, options.soak_s, maximum_per_s)


def growth_kib(resident_kib: Sequence[float]) -> float:
    """Return the growth of memory from the second quarter to the last, without the start-up."""
    quarter = max(len(resident_kib) // 4, 1)
    return median(resident_kib[-quarter:]) - median(resident_kib[quarter : 2 * quarter])


def _soak_rows(relay: Relay, seconds: int, maximum_per_s: float) -> list[Row]:
    """Load a relay with half of its maximum rate, in groups of datagrams; return the rows."""
    group = max(round(maximum_per_s / 2 * _GROUP_S), 1)
    period_ns = round(group / (maximum_per_s / 2) * 1e9)
    groups_per_s = round(1e9 / period_ns)
    counts, resident_kib = new_soak(), list[float]()
    begun_s, before_s = time.monotonic(), relay.scheduled_s()
    for number in range(seconds):
        if number % 60 == 0:
            say(f"{group * groups_per_s:,} datagrams/s, {number} of {seconds} s")
        relay.ends.soak(counts, groups_per_s, group, period_ns)
        resident_kib.append(psutil.Process(relay.pid).memory_info().rss / 1024)
    elapsed_s = time.monotonic() - begun_s
    cpu_s, waited_s = np.subtract(relay.scheduled_s(), before_s).tolist()
    # Empty groups: receive the datagrams still in flight.
    relay.ends.soak(counts, round(_LAST_S / _GROUP_S), 0, period_ns)
    totals, none, waited = relay.totals(), Goal("==", 0), waited_s / elapsed_s
    return [
        Row("load", counts.sent / elapsed_s, "datagrams/s",
            Peer("drained maximum", maximum_per_s), note=f"for {elapsed_s:.0f} s"),
        Row("sent but not counted as arrived", counts.sent - totals.arrived, "datagrams",
            goal=none),
        Row("forwarded but not received", totals.forwarded - counts.received, "datagrams",
            goal=none),
        Row("lost in the relay's receive buffer", totals.lost_in_kernel, "datagrams", goal=none),
        Row("longest loss burst", counts.longest_gap, "datagrams", goal=Goal("<=", MANSD)),
        Row("received out of order", counts.disordered, "datagrams", goal=none),
        Row("memory, last quarter beyond second", growth_kib(resident_kib), "KiB",
            goal=MEMORY_GOAL, note=f"of {resident_kib[-1] / 1024:.0f} MiB"),
        Row("CPU of the relay", 100 * cpu_s / elapsed_s, "% of a core"),
        Row("the relay waited for its core", 100 * waited, "% of the time",
            note="others had its core: a loss may be theirs" if waited > _STARVED else None),
    ]  # fmt: skip


_SHELL_ROUNDS = 5
_PINGS = 500
_SECONDS = 3
_PORT = 5209
_SHELL, _BARE_FORWARDER, _LOSS, _DELAY = (
    "noack netem shell",
    "bare forwarder in C",
    "mm-loss",
    "mm-delay",
)
_SHELLS = {
    _SHELL: [sys.executable, "-m", "netem", "shell", "--"],
    _LOSS: ["mm-loss", "uplink", "0"],
    _DELAY: ["mm-delay", "0"],
}
_Run = Callable[[str], str]
"""Runs a command line of sh inside, where ``$TO`` is the outside; returns its output."""


def _bare(command: str, forwarder: Path) -> str:
    link = open_devices(LinkSpec("bare", ("", 0), ("", 0), LinkSettings(), LinkSettings()))
    with ExitStack() as stack:
        stack.callback(link.close)
        words = [str(forwarder), *map(str, link.devices)]
        process = stack.enter_context(subprocess.Popen(words, pass_fds=link.devices))
        stack.callback(process.kill)
        with link.inside():
            variables = os.environ | {"TO": link.spec.to[0]}
            words = ["sh", "-c", command]
            inner = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=variables)
        return inner.communicate()[0]


def _in_shell(name: str, command: str) -> str:
    script = f"TO=${{NOACK_OUTSIDE:-$MAHIMAHI_BASE}}; {command}"
    words = [*_SHELLS[name], "sh", "-c", script]
    return subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True).stdout


def _shell_figures(run: _Run) -> dict[str, float] | str:
    """Measure throughput from inside to outside, and the time to there and back."""
    try:
        end = json.loads(run(f"iperf3 -J -c $TO -p {_PORT} -t {_SECONDS}"))["end"]
        pings = run(f"ping -q -i 0.002 -c {_PINGS} $TO")
        (trip_ms,) = re.findall(r"= [\d.]+/([\d.]+)/", pings)
        return {"mbit": end["sum_received"]["bits_per_second"] / 1e6, "us": 1e3 * float(trip_ms)}
    except (ValueError, KeyError):
        return "its programs did not report"


@benchmark("shell", "A shell: throughput of TCP, and time to the outside and back")
def shell(_options: argparse.Namespace) -> Iterator[Row]:
    """Measure a shell without impairments, in turn with the alternatives; needs root for these."""
    if missing := [one for one in ("iperf3", "ping", "ip") if shutil.which(one) is None]:
        raise MeasurementError(f"there is no {', '.join(missing)}")
    rounds = Rounds()
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder, ExitStack() as stack:
        forwarder = compiled("tun.c", Path(folder))
        server = ["iperf3", "-s", "-p", str(_PORT)]
        process = stack.enter_context(subprocess.Popen(server, stdout=subprocess.DEVNULL))
        stack.callback(process.kill)
        for _ in range(_SHELL_ROUNDS):
            rounds.add(_BARE_FORWARDER, _shell_figures(lambda command: _bare(command, forwarder)))
            for name, words in _SHELLS.items():
                if shutil.which(words[0]) is None:
                    rounds.add(name, f"there is no {words[0]}")
                else:
                    rounds.add(name, _shell_figures(lambda command, one=name: _in_shell(one, command)))
    for peer in (_BARE_FORWARDER, _LOSS, _DELAY):
        goal = Goal(">=", 0.9) if peer == _BARE_FORWARDER else None
        yield rounds.row("TCP", "Mbit/s", "mbit", _SHELL, peer, goal, paired=True)
        yield rounds.row("ping, mean", "µs", "us", _SHELL, peer, paired=True)

"""Relays, ours (``python -m netem``) and others, under load: rate, cost, delay, flows, memory.

The load is ``load.c``: this process is sender and sink of every relay. Arrival times are the
kernel's timestamps, so that they do not depend on the time at which the sink is read.

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
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import psutil
from cffi import FFI

from benchmarks.latency import KERNEL, cyclictest
from benchmarks.programs import BEFORE_OTHERS, LOAD_CORE, RELAY_CORE, compiled, on_core, scheduled
from benchmarks.report import (
    Figures,
    Goal,
    MeasurementError,
    Peer,
    Rounds,
    Row,
    benchmark,
    median,
    say,
)

DATAGRAM_BYTES = 72
LOOPBACK = "127.0.0.1"
BURST = 8000
"""Datagrams in a burst, if the relay's receive buffer holds that many."""
_PROBE = 20_000
_LOSSY_SLACK = 16
"""With 5 % loss, this number of consecutive losses does not occur within a benchmark."""
_READY_S, _END_S = 120.0, 30.0
"""Maximum waits for a relay to listen (a busy machine starts it late), and to end."""
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 33, 35
_SINK_BUFFER_BYTES = 64 * 1024 * 1024
_KERNEL_BYTES = 1024
"""Upper bound on the bytes of a receive buffer that a small datagram occupies."""
_PATIENCE_NS = 300_000_000
"""After this time without an arrival, the rest of a burst counts as lost."""
_PING_TIMEOUT_S = 0.2
_PORT = re.compile(r"^(\d+)$")
_READY = re.compile(r"noack netem: 127\.0\.0\.1:(\d+) →")
_DECLARATIONS = """
struct burst { int64_t wall_ns, last, received; };
struct soak { int64_t sent, received, next, longest_gap, disordered; };
int load_burst(int, int, int, int64_t, int64_t, int64_t, const uint32_t *, int64_t, int64_t,
               int64_t, struct burst *);
int load_direct(int, int, int64_t, int64_t, int64_t, int64_t, struct burst *, int64_t *);
int load_ping(int, int, int64_t, int64_t, int64_t, int64_t *);
int load_pace(int, int64_t, int64_t, int64_t, int64_t, int64_t *);
int load_collect(int, int64_t, int64_t, int64_t, int64_t *);
int load_soak(int, int, int64_t, int64_t, int64_t, int64_t, struct soak *);
"""
_FFI = FFI()
_FFI.cdef(_DECLARATIONS)

Nanoseconds = npt.NDArray[np.int64]
Addresses = npt.NDArray[np.uint32]


class Burst(NamedTuple):
    """Result of a burst."""

    wall_s: float
    """Time from the relay's continuation to the last arrival."""
    decided: int
    """Datagrams up to the last one that arrived: the relay has received and decided these."""
    received: int
    """Datagrams that arrived."""


class Built(NamedTuple):
    """The code compiled for a benchmark: the library of ``load.c``, and ``relay.c``."""

    load: Any
    relay: Path


@contextmanager
def built() -> Iterator[Built]:
    """Compile the load and the C relay; they exist within the context.

    Raises:
        MeasurementError: there is no C compiler, or it fails.
    """
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        load = compiled("load.c", Path(folder), "-shared", "-fPIC")
        yield Built(_FFI.dlopen(str(load)), compiled("relay.c", Path(folder)))


def sources(count: int) -> Addresses:
    """``count`` loopback addresses (127.1.0.0 and on) in network byte order, for the C code."""
    return (np.uint32(0x7F010000) + np.arange(count, dtype=np.uint32)).astype(">u4").view(np.uint32)


def new_soak() -> Any:
    """Return counts of a steady load, all 0: a ``struct soak`` of ``load.c``."""
    return _FFI.new("struct soak *")


class Ends:
    """Both ends of a path through a relay: a sender connected to it, and the sink behind it.

    All datagrams are numbered consecutively from 0.
    """

    def __init__(self, load: Any) -> None:
        self._load = load
        self.sent = 0
        self.sink, self.out = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
        self.sink.bind((LOOPBACK, 0))
        option = partial(self.sink.setsockopt, socket.SOL_SOCKET)
        try:
            option(_SO_RCVBUFFORCE, _SINK_BUFFER_BYTES)
        except PermissionError:
            option(socket.SO_RCVBUF, _SINK_BUFFER_BYTES)
        buffer_bytes = self.sink.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        self.sink_holds = buffer_bytes // _KERNEL_BYTES
        """Number of datagrams that can wait at the sink."""
        option(_SO_TIMESTAMPNS, 1)
        option(socket.SO_RCVTIMEO, struct.pack("@ll", 0, round(_PING_TIMEOUT_S * 1e6)))

    @property
    def sink_port(self) -> int:
        """The port on loopback to which the relay sends."""
        return int(self.sink.getsockname()[1])

    def connect(self, port: int) -> None:
        """Send to this port on loopback from now on."""
        self.out.connect((LOOPBACK, port))

    def close(self) -> None:
        """Close both sockets."""
        self.out.close()
        self.sink.close()

    def burst(
        self, relay: int, count: int, slack: int = 0, addresses: Addresses | None = None
    ) -> Burst:
        """Stop the relay, fill its receive buffer, continue it, and wait until the buffer is empty.

        Args:
            relay: process id of the relay, a child of this process.
            count: datagrams to send.
            slack: the burst may end although this number of last datagrams have not arrived.
            addresses: send from these in turn; see :func:`sources`.
        """
        found = _FFI.new("struct burst *")
        senders = (_FFI.NULL, 0)
        if addresses is not None:
            senders = (_FFI.from_buffer("uint32_t[]", addresses), len(addresses))
        self._call("burst", self.sink.fileno(), relay, self._first(count), count, DATAGRAM_BYTES,
                   *senders, slack, _PATIENCE_NS, found)  # fmt: skip
        return Burst(found.wall_ns * 1e-9, found.last + 1, found.received)

    def direct(self, count: int) -> tuple[Burst, float]:
        """Send directly to the sink; also return the CPU time in seconds."""
        found, cpu_ns = _FFI.new("struct burst *"), _FFI.new("int64_t *")
        self._call("direct", self.sink.fileno(), self._first(count), count, DATAGRAM_BYTES,
                   _PATIENCE_NS, found, cpu_ns)  # fmt: skip
        return Burst(found.wall_ns * 1e-9, found.last + 1, found.received), cpu_ns[0] * 1e-9

    def ping(self, count: int) -> Nanoseconds:
        """Return the one-way delays of datagrams sent one by one, ns; -1 for a missing one."""
        delays_ns = np.empty(count, np.int64)
        self._call("ping", self.sink.fileno(), self._first(count), count, DATAGRAM_BYTES,
                   _numbers(delays_ns))  # fmt: skip
        return delays_ns

    def pace(self, count: int, period_ns: int) -> Nanoseconds:
        """Return the one-way delays of datagrams sent every ``period_ns``, ns; -1: missing."""
        departures_ns, arrivals_ns = np.empty(count, np.int64), np.full(count, -1, np.int64)
        first = self._first(count)
        self._call("pace", first, count, DATAGRAM_BYTES, period_ns, _numbers(departures_ns))
        self._load.load_collect(
            self.sink.fileno(), first, count, _PATIENCE_NS, _numbers(arrivals_ns)
        )
        return np.where(arrivals_ns < 0, -1, arrivals_ns - departures_ns)

    def soak(self, state: Any, groups: int, group: int, period_ns: int) -> None:
        """Send ``groups`` groups of ``group`` datagrams, one group every ``period_ns``."""
        self._call("soak", self.sink.fileno(), groups, group, DATAGRAM_BYTES, period_ns, state)

    def _first(self, count: int) -> int:
        first, self.sent = self.sent, self.sent + count
        return first

    def _call(self, function: str, *arguments: object) -> None:
        number = getattr(self._load, f"load_{function}")(self.out.fileno(), *arguments)
        if number != 0:
            raise MeasurementError(f"{function}: {os.strerror(number)}")


def _numbers(array: Nanoseconds) -> Any:
    return _FFI.from_buffer("int64_t[]", array)


class Kind(NamedTuple):
    """A kind of relay."""

    name: str
    command: Callable[[int, int], list[str]]
    """Returns its command line for the sink's port and a free port to listen on."""
    says: tuple[str, re.Pattern[str]] | None = ("stdout", _PORT)
    """Where and how it reports its listening port; None if it is the given free port."""
    lossy: bool = False
    """Whether it may lose datagrams."""


_MODES = {"segment": "segments", "names": "senders' addresses", "paths": "a socket per client"}


def c_relay(built: Built, *words: str) -> Kind:
    """Return ``relay.c`` in one of its modes, ``segment``, ``names`` and ``paths``."""
    name = ", ".join(["C relay", *(_MODES[word] for word in words)])
    return Kind(name, lambda to, _: [str(built.relay), str(to), *words])


def socat() -> Kind | str:
    """Return socat, forward only; or why it is missing."""
    program = shutil.which("socat")
    if program is None:
        return "socat is not installed (Debian: apt-get install socat)"
    ends = (f"UDP4-RECV:{{}},rcvbuf={4 * 2**20}", f"UDP4-SENDTO:{LOOPBACK}:{{}}")
    return Kind(
        "socat",
        lambda to, port: [program, "-u", "-b", "2048", ends[0].format(port), ends[1].format(to)],
        says=None,
    )


def our_relay(
    name: str, words: str, *flags: str, reverse: bool = False, lossy: bool = True
) -> Kind:
    """Return ``python -m netem`` with impairments in tc's words, maybe with a reverse direction."""
    one_way = [] if reverse else ["--one-way"]

    def command(to: int, _: int) -> list[str]:
        ends = ("--listen", f"{LOOPBACK}:0", "--to", f"{LOOPBACK}:{to}")
        return [sys.executable, "-m", "netem", *ends, *words.split(), *flags, *one_way, "--json"]

    return Kind(name, command, ("stderr", _READY), lossy)


class Totals(NamedTuple):
    """Our relay's final counts."""

    arrived: int
    forwarded: int
    longest_loss_burst: int
    lost_in_kernel: int

    @classmethod
    def parse(cls, stdout: str) -> "Totals":
        """Read the output of the relay with ``--json``.

        Raises:
            MeasurementError: the output is not as expected.
        """
        try:
            _, _, totals = stdout.partition("\n")  # the first line reports that it is ready
            forward = json.loads(totals)["links"][0]["forward"]
            lost_in_kernel = forward["unintended"]["lost_in_kernel"]
            keys = ("received", "forwarded", "longest_loss_burst")
            return cls(*(forward[key] for key in keys), lost_in_kernel)
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise MeasurementError(f"our relay's totals cannot be read: {error!r}") from None


def figures_of(name: str, burst: Burst, sent: int, slack: int, cpu_s: float) -> Figures:
    """Return ``per_s``, datagrams received and decided per second, and ``cpu_us`` per datagram.

    Raises:
        MeasurementError: more datagrams are missing than the relay can have dropped.
    """
    if burst.decided < sent - slack or (slack == 0 and burst.received != sent):
        raise MeasurementError(f"{name}: of a burst of {sent} only {burst.received} arrived")
    return {"per_s": burst.decided / burst.wall_s, "cpu_us": cpu_s / sent * 1e6}


class Relay:
    """A running relay with its sender and sink."""

    def __init__(self, kind: Kind, process: subprocess.Popen[str], ends: Ends) -> None:
        self.name = kind.name
        self.ends = ends
        self.pid = process.pid
        self._process = process
        self._slack = _LOSSY_SLACK if kind.lossy else 0
        self._burst = 0

    def scheduled_s(self) -> tuple[float, float]:
        """CPU time of all its threads so far, and time in which other threads had their core."""
        tasks = Path(f"/proc/{self.pid}/task").glob("*/schedstat")
        found = [[int(word) for word in task.read_text().split()[:2]] for task in tasks]
        return sum(one for one, _ in found) * 1e-9, sum(one for _, one in found) * 1e-9

    def burst(self, addresses: Addresses | None = None) -> Figures:
        """Send it one burst, from these addresses in turn if there are any.

        The first time, also determine the capacity of its buffer.
        """
        if not self._burst:
            held = self.ends.burst(self.pid, _PROBE, addresses=addresses).decided
            self._burst = min(BURST, held * 9 // 10)
            if not self._burst:
                raise MeasurementError(f"{self.name} forwards nothing")
        before_s, _ = self.scheduled_s()
        found = self.ends.burst(self.pid, self._burst, self._slack, addresses)
        cpu_s = self.scheduled_s()[0] - before_s
        return figures_of(self.name, found, self._burst, self._slack, cpu_s)

    def totals(self) -> Totals:
        """End our relay as Ctrl-C does; return its totals."""
        self._process.send_signal(signal.SIGINT)
        try:
            stdout, _ = self._process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            raise MeasurementError(f"{self.name} does not end") from None
        return Totals.parse(stdout)


@contextmanager
def running(kind: Kind, built: Built) -> Iterator[Relay]:
    """Run a relay on its core, between sender and sink.

    Raises:
        MeasurementError: it does not start to listen.
    """
    ends = Ends(built.load)
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        chosen = int(probe.getsockname()[1])
    with on_core(RELAY_CORE):
        process = subprocess.Popen(
            kind.command(ends.sink_port, chosen),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    try:
        ends.connect(_listening_on(kind, process, chosen))
        yield Relay(kind, process, ends)
    finally:
        process.kill()
        process.communicate()
        ends.close()


def _listening_on(kind: Kind, process: subprocess.Popen[str], chosen: int) -> int:
    deadline = threading.Timer(_READY_S, process.kill)
    deadline.start()
    try:
        if kind.says is None:
            while process.poll() is None:
                lines = Path("/proc/net/udp").read_text().splitlines()[1:]
                if chosen in (int(line.split()[1].rpartition(":")[2], 16) for line in lines):
                    return chosen
                time.sleep(0.01)
        else:
            stream, port = kind.says
            said: IO[str] = getattr(process, stream)
            for line in said:
                if (found := port.search(line)) is not None:
                    return int(found[1])
    finally:
        deadline.cancel()
    _, stderr = process.communicate()
    why = (stderr.strip() or "nothing").splitlines()[-1]
    raise MeasurementError(f"{kind.name} does not begin to listen, said {why!r}")


class Sides:
    """Relays that run until the context ends, and are measured in turn, and maybe no relay.

    A relay that does not start, or fails, is missing in the rounds from then on.
    """

    def __init__(self, kinds: Sequence[tuple[str, Kind | str]], built: Built) -> None:
        self.rounds = Rounds()
        self._kinds, self._built = kinds, built
        self._stack = ExitStack()
        self.relays: list[Relay] = []

    def __enter__(self) -> "Sides":
        for name, kind in self._kinds:
            if isinstance(kind, str):
                self.rounds.add(name, kind)
                continue
            try:
                self.relays.append(self._stack.enter_context(running(kind, self._built)))
            except MeasurementError as error:
                self.rounds.add(name, str(error))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def direct(self) -> Ends:
        """Return a sender whose datagrams go directly to the sink."""
        ends = Ends(self._built.load)
        self._stack.callback(ends.close)
        ends.connect(ends.sink_port)
        return ends

    def in_turn(self, measure: Callable[[Relay], Mapping[str, Figures]]) -> None:
        """Measure one round of each relay; the figures are those of one or several sides."""
        for relay in list(self.relays):
            try:
                for side, figures in measure(relay).items():
                    self.rounds.add(side, figures)
            except MeasurementError as error:
                self.rounds.add(relay.name, str(error))
                self.relays.remove(relay)


ROUNDS = 40
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


FLOW_ROUNDS, FLOWS = 30, 10_000
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
        kinds = [c_relay(tools), c_relay(tools, "paths"), our_relay(PLAIN, WORDS),
                 our_relay(REVERSE, WORDS, reverse=True)]  # fmt: skip
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


PING_ROUNDS, PINGS = 60, 500
LINE_ROUNDS, LINE_ROUND_S = 8, 2
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
    "relay_soak", "Our relay under a steady load",
    {"--soak-s": {"type": _seconds, "default": 20, "metavar": "S",
                  "help": "length of relay_soak (%(default)s)"}},
)  # fmt: skip
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

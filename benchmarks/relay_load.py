"""The load of the relay benchmarks, and the relays that run under it.

The load is ``load.c``: this process is sender and sink of every relay. Arrival times are the
kernel's timestamps, so that they do not depend on the time at which the sink is read.
"""

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
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from cffi import FFI

from benchmarks.programs import RELAY_CORE, compiled, on_core
from benchmarks.report import Figures, MeasurementError, Rounds

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
    """Compile the load and the C relay; they exist within the context."""
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

    def burst(self, relay: int, count: int, slack: int = 0, addresses: Addresses | None = None) -> Burst:
        """Stop the relay, fill its receive buffer, continue it, and wait until the buffer is empty.

        Args:
            relay: process id of the relay, a child of this process.
            count: datagrams to send.
            slack: the burst may end although this number of last datagrams have not arrived.
            addresses: send from these in turn; see :func:`sources`.
        """
        result = _FFI.new("struct burst *")
        senders = (_FFI.NULL, 0)
        if addresses is not None:
            senders = (_FFI.from_buffer("uint32_t[]", addresses), len(addresses))
        self._call("burst", self.sink.fileno(), relay, self._first(count), count, DATAGRAM_BYTES,
                   *senders, slack, _PATIENCE_NS, result)  # fmt: skip
        return Burst(result.wall_ns * 1e-9, result.last + 1, result.received)

    def direct(self, count: int) -> tuple[Burst, float]:
        """Send directly to the sink; also return the CPU time in seconds."""
        result, cpu_ns = _FFI.new("struct burst *"), _FFI.new("int64_t *")
        self._call("direct", self.sink.fileno(), self._first(count), count, DATAGRAM_BYTES,
                   _PATIENCE_NS, result, cpu_ns)  # fmt: skip
        return Burst(result.wall_ns * 1e-9, result.last + 1, result.received), cpu_ns[0] * 1e-9

    def ping(self, count: int) -> Nanoseconds:
        """Return the one-way delays of datagrams sent one by one, ns; -1 for a missing one."""
        delays_ns = np.empty(count, np.int64)
        self._call("ping", self.sink.fileno(), self._first(count), count, DATAGRAM_BYTES, _numbers(delays_ns))
        return delays_ns

    def pace(self, count: int, period_ns: int) -> Nanoseconds:
        """Return the one-way delays of datagrams sent every ``period_ns``, ns; -1: missing."""
        departures_ns, arrivals_ns = np.empty(count, np.int64), np.full(count, -1, np.int64)
        first = self._first(count)
        self._call("pace", first, count, DATAGRAM_BYTES, period_ns, _numbers(departures_ns))
        self._load.load_collect(self.sink.fileno(), first, count, _PATIENCE_NS, _numbers(arrivals_ns))
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


def socat() -> Kind:
    """Return socat, forward only."""

    def command(to: int, port: int) -> list[str]:
        if (program := shutil.which("socat")) is None:
            raise MeasurementError("socat is not installed (Debian: apt-get install socat)")
        listen = f"UDP4-RECV:{port},rcvbuf={4 * 2**20}"
        return [program, "-u", "-b", "2048", listen, f"UDP4-SENDTO:{LOOPBACK}:{to}"]

    return Kind("socat", command, says=None)


def our_relay(name: str, words: str, *flags: str, reverse: bool = False, lossy: bool = True) -> Kind:
    """Return ``python -m netem`` with impairments in tc's words, maybe with a reverse direction."""
    one_way = [] if reverse else ["--one-way"]

    def command(to: int, _: int) -> list[str]:
        ends = ("--listen", f"{LOOPBACK}:0", "--to", f"{LOOPBACK}:{to}")
        return [sys.executable, "-m", "netem", *ends, *words.split(), *flags, *one_way, "--json"]

    return Kind(name, command, ("stderr", _READY), lossy)


class Totals(NamedTuple):
    """Our relay's final counts."""

    received: int
    forwarded: int
    longest_loss_burst: int
    lost_in_kernel: int


def figures_of(name: str, burst: Burst, cpu_s: float, sent: int, slack: int = 0) -> Figures:
    """Return ``per_s``, datagrams received and decided per second, and ``cpu_us`` per datagram."""
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
        times_ns = [[int(word) for word in task.read_text().split()[:2]] for task in tasks]
        return sum(run_ns for run_ns, _ in times_ns) * 1e-9, sum(run_ns for _, run_ns in times_ns) * 1e-9

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
        result = self.ends.burst(self.pid, self._burst, self._slack, addresses)
        cpu_s = self.scheduled_s()[0] - before_s
        return figures_of(self.name, result, cpu_s, self._burst, self._slack)

    def totals(self) -> Totals:
        """End our relay as Ctrl-C does; return its totals."""
        self._process.send_signal(signal.SIGINT)
        try:
            stdout, _ = self._process.communicate(timeout=_END_S)
            _, _, totals = stdout.partition("\n")  # the first line reports that it is ready
            forward = json.loads(totals)["links"][0]["forward"]
            values = forward | forward["unintended"]
            return Totals(*(values[key] for key in Totals._fields))
        except (subprocess.TimeoutExpired, ValueError, LookupError, TypeError) as error:
            raise MeasurementError(f"the totals of {self.name} cannot be read: {error!r}") from None


@contextmanager
def running(kind: Kind, built: Built) -> Iterator[Relay]:
    """Run a relay on its core, between sender and sink."""
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        chosen = int(probe.getsockname()[1])
    with closing(Ends(built.load)) as ends:
        command = kind.command(ends.sink_port, chosen)
        with on_core(RELAY_CORE):
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            ends.connect(_listening_on(kind, process, chosen))
            yield Relay(kind, process, ends)
        finally:
            process.kill()
            process.communicate()


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
            output: IO[str] = getattr(process, stream)
            for line in output:
                if (match := port.search(line)) is not None:
                    return int(match[1])
    finally:
        deadline.cancel()
    _, stderr = process.communicate()
    why = (stderr.strip() or "nothing").splitlines()[-1]
    raise MeasurementError(f"{kind.name} does not begin to listen, said {why!r}")


@contextmanager
def started(kinds: Iterable[Kind], built: Built) -> Iterator[tuple[Rounds, list[Relay]]]:
    """Run relays within the context; the rounds say which ones did not start, and why."""
    rounds, relays = Rounds(), list[Relay]()
    with ExitStack() as stack:
        for kind in kinds:
            try:
                relays.append(stack.enter_context(running(kind, built)))
            except MeasurementError as error:
                rounds.add(kind.name, str(error))
        yield rounds, relays


@contextmanager
def direct_ends(built: Built) -> Iterator[Ends]:
    """Give a sender whose datagrams go directly to the sink."""
    with closing(Ends(built.load)) as ends:
        ends.connect(ends.sink_port)
        yield ends

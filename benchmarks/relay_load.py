"""The load of the relay benchmarks, and the relays that run under it.

The load is ``load.c``: this process is sender and sink of every relay. Arrival times are the
kernel's timestamps, so that they do not depend on the time at which the sink is read.
"""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from cffi import FFI

from benchmarks.programs import RELAY_CORE, compile_program, on_core, program_path
from benchmarks.report import Figures, MeasurementError, Rounds
from noack.runtime.address import LOOPBACK

DATAGRAM_BYTES = 72
BURST = 8000
"""Datagrams in a burst, if the relay's receive buffer holds that many."""
_PROBE_DATAGRAMS = 20_000
"""Datagrams of a first burst, by which the capacity of a relay's buffer is measured."""
_LOSSY_SLACK = 16
"""With 5 % loss, this number of consecutive losses does not occur within a benchmark."""
_READY_S, _END_S = 120.0, 30.0
"""Maximum waits for a relay to listen (a busy machine starts it late), and to end."""
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 33, 35
_SINK_BUFFER_BYTES = 64 * 1024 * 1024
_PATIENCE_NS = 300_000_000
"""After this time without an arrival, the rest of a burst counts as lost."""
_PING_TIMEOUT_S = 0.2
_FFI = FFI()
_FFI.cdef(Path(__file__).with_name("load.h").read_text())

Nanoseconds = npt.NDArray[np.int64]
Addresses = npt.NDArray[np.uint32]


class CompiledCode(NamedTuple):
    """The code compiled for a benchmark: the library of ``load.c``, and ``relay.c``."""

    load: Any
    relay: Path


@contextmanager
def compiled_code() -> Iterator[CompiledCode]:
    """Compile the load and the C relay; they exist within the context."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder:
        load = compile_program("load.c", Path(folder), "-shared", "-fPIC")
        yield CompiledCode(_FFI.dlopen(str(load)), compile_program("relay.c", Path(folder)))


def sources(count: int) -> Addresses:
    """``count`` loopback addresses (127.1.0.0 and on) in network byte order, for the C code."""
    return (np.uint32(0x7F010000) + np.arange(count, dtype=np.uint32)).astype(">u4").view(np.uint32)


def new_soak() -> Any:
    """Return counts of a steady load, all 0: a ``struct soak`` of ``load.c``."""
    return _FFI.new("struct soak *")


class PathEnds:
    """Both ends of a path through a relay: a sender connected to it, and the sink behind it.

    All datagrams are numbered consecutively from 0.
    """

    def __init__(self, load: Any) -> None:
        self._load = load
        self._sent_count = 0
        self.sink, self.out = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
        self.sink.bind((LOOPBACK, 0))
        option = partial(self.sink.setsockopt, socket.SOL_SOCKET)
        try:
            option(_SO_RCVBUFFORCE, _SINK_BUFFER_BYTES)
        except PermissionError:
            option(socket.SO_RCVBUF, _SINK_BUFFER_BYTES)
        option(_SO_TIMESTAMPNS, 1)
        option(socket.SO_RCVTIMEO, struct.pack("@ll", 0, round(_PING_TIMEOUT_S * 1e6)))

    def close(self) -> None:
        """Close both sockets."""
        self.out.close()
        self.sink.close()

    def burst(self, relay: int, count: int, slack: int, addresses: Addresses | None) -> Any:
        """Stop the relay, fill its receive buffer, continue it, and wait until the buffer is empty.

        Args:
            relay: process id of the relay, a child of this process.
            count: datagrams to send.
            slack: the burst may end although this number of last datagrams have not arrived.
            addresses: send from these in turn; see :func:`sources`.

        Returns:
            A ``struct burst`` of ``load.c``: time, number of the last arrival, number of arrivals.
        """
        result = _FFI.new("struct burst *")
        senders = (_FFI.NULL, 0)
        if addresses is not None:
            senders = (_FFI.from_buffer("uint32_t[]", addresses), len(addresses))
        self._call("burst", self.sink.fileno(), relay, self._first(count), count, DATAGRAM_BYTES,
                   *senders, slack, _PATIENCE_NS, result)  # fmt: skip
        return result

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
        first, self._sent_count = self._sent_count, self._sent_count + count
        return first

    def _call(self, function: str, *arguments: object) -> None:
        number = getattr(self._load, f"load_{function}")(self.out.fileno(), *arguments)
        if number != 0:
            raise MeasurementError(f"{function}: {os.strerror(number)}")


def _numbers(array: Nanoseconds) -> Any:
    return _FFI.from_buffer("int64_t[]", array)


class RelayKind(NamedTuple):
    """A kind of relay."""

    name: str
    command: Callable[[int, int], list[str]]
    """Returns its command line for the ports on loopback from which and to which it relays."""
    lossy: bool = False
    """Whether it may lose datagrams."""


_MODES = {"segment": "segments", "names": "senders' addresses", "paths": "a socket per client"}


def c_relay(code: CompiledCode, *words: str) -> RelayKind:
    """Return ``relay.c`` in one of its modes, ``segment``, ``names`` and ``paths``."""
    name = ", ".join(["C relay", *(_MODES[word] for word in words)])
    return RelayKind(name, lambda port, to: [str(code.relay), str(port), str(to), *words])


def socat() -> RelayKind:
    """Return socat, forward only."""

    def command(port: int, to: int) -> list[str]:
        listen = f"UDP4-RECV:{port},rcvbuf={4 * 2**20}"
        return [program_path("socat", "socat"), "-u", "-b", "2048", listen, f"UDP4-SENDTO:{LOOPBACK}:{to}"]

    return RelayKind("socat", command)


def our_relay(name: str, words: str, *flags: str, reverse: bool = False, lossy: bool = True) -> RelayKind:
    """Return ``python -m netem`` with impairments in tc's words, maybe with a reverse direction."""
    options = (*words.split(), *flags, *(() if reverse else ("--one-way",)), "--json")

    def command(port: int, to: int) -> list[str]:
        ends = ("--listen", f"{LOOPBACK}:{port}", "--to", f"{LOOPBACK}:{to}")
        return [sys.executable, "-m", "netem", *ends, *options]

    return RelayKind(name, command, lossy)


class LoadedRelay:
    """A running relay with its sender and sink."""

    def __init__(self, kind: RelayKind, process: subprocess.Popen[str], ends: PathEnds) -> None:
        self.name = kind.name
        self.ends = ends
        self.pid = process.pid
        self._process = process
        self._slack = _LOSSY_SLACK if kind.lossy else 0
        self._burst = 0

    @property
    def cpu_s(self) -> float:
        """CPU time of all its threads so far."""
        tasks = Path(f"/proc/{self.pid}/task").glob("*/schedstat")
        return sum(int(task.read_text().split()[0]) for task in tasks) * 1e-9

    def burst(self, addresses: Addresses | None = None) -> Figures:
        """Send it one burst, from these addresses in turn if there are any.

        The first time, also determine the capacity of its buffer.

        Returns:
            ``per_s``: datagrams per second, received and decided until the last arrival, from its
            continuation on; ``cpu_us``: CPU time for each.
        """
        if not self._burst:
            capacity = self.ends.burst(self.pid, _PROBE_DATAGRAMS, 0, addresses).last + 1
            self._burst = min(BURST, capacity * 9 // 10)
            if not self._burst:
                raise MeasurementError(f"{self.name} forwards nothing")
        sent, before_s = self._burst, self.cpu_s
        result = self.ends.burst(self.pid, sent, self._slack, addresses)
        cpu_s, decisions = self.cpu_s - before_s, result.last + 1
        if decisions < sent - self._slack or (self._slack == 0 and result.received != sent):
            raise MeasurementError(f"{self.name}: of a burst of {sent} only {result.received} arrived")
        return {"per_s": decisions / result.wall_ns * 1e9, "cpu_us": cpu_s / sent * 1e6}

    def totals(self) -> dict[str, int]:
        """End our relay as Ctrl-C does; return its counts of the datagrams towards the sink."""
        self._process.send_signal(signal.SIGINT)
        stdout, _ = self._process.communicate(timeout=_END_S)
        _, _, totals = stdout.partition("\n")  # the first line reports that it is ready
        (link,) = json.loads(totals)["links"]
        return {**link["forward"], **link["forward"]["unintended"]}


@contextmanager
def running(kind: RelayKind, code: CompiledCode) -> Iterator[LoadedRelay]:
    """Run a relay on its core, between sender and sink."""
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        port = int(probe.getsockname()[1])
    with closing(PathEnds(code.load)) as ends, ExitStack() as stack:
        command = kind.command(port, ends.sink.getsockname()[1])
        with on_core(RELAY_CORE):
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        stack.callback(process.communicate)
        stack.callback(process.kill)
        limit_s = time.monotonic() + _READY_S
        while not _is_bound(port):
            if process.poll() is not None or time.monotonic() > limit_s:
                process.kill()
                raise MeasurementError(f"{kind.name} does not listen: {process.communicate()[1].strip()}")
            time.sleep(0.01)
        ends.out.connect((LOOPBACK, port))
        yield LoadedRelay(kind, process, ends)


def _is_bound(port: int) -> bool:
    """Whether a UDP socket of this host has a port."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(int(line.split()[1].rpartition(":")[2], 16) == port for line in lines)


@contextmanager
def started(kinds: Iterable[RelayKind], code: CompiledCode) -> Iterator[tuple[Rounds, list[LoadedRelay]]]:
    """Run relays within the context; the rounds say which ones did not start, and why."""
    rounds, relays = Rounds(), list[LoadedRelay]()
    with ExitStack() as stack:
        for kind in kinds:
            try:
                relays.append(stack.enter_context(running(kind, code)))
            except MeasurementError as error:
                rounds.add(kind.name, str(error))
        yield rounds, relays


@contextmanager
def direct_ends(code: CompiledCode) -> Iterator[PathEnds]:
    """Give a sender whose datagrams go directly to the sink."""
    with closing(PathEnds(code.load)) as ends:
        ends.out.connect(ends.sink.getsockname())
        yield ends

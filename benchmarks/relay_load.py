"""The load of the relay benchmarks, and the relays that run under it.

The load is ``load.c``: this process is sender and sink of every relay. Arrival times are the
kernel's timestamps, so that they do not depend on the time at which the sink is read.
"""

import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from cffi import FFI

from benchmarks.programs import RELAY_CORE, compile_program, program_path
from benchmarks.report import MeasurementError
from benchmarks.rounds import Figures, Rounds
from netem.core.address import LOOPBACK
from tests.helpers.waiting import wait_for

BURST = 8000
"""Datagrams in a burst, if the relay's receive buffer holds that many."""
_PROBE_DATAGRAMS = 20_000
"""Datagrams of a first burst, by which the capacity of a relay's buffer is measured."""
_LOSSY_SLACK = 16
"""With 5 % loss, this number of consecutive losses does not occur within a benchmark."""
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 33, 35
_SINK_BUFFER_BYTES = 64 * 1024 * 1024
_PING_TIMEOUT_S = 0.2
_FFI = FFI()

Nanoseconds = npt.NDArray[np.int64]
Addresses = npt.NDArray[np.uint32]


@cache
def _load() -> Any:
    """Compile ``load.c``; return the library."""
    _FFI.cdef(Path(__file__).with_name("load.h").read_text())
    return _FFI.dlopen(compile_program("load.c", "-shared", "-fPIC"))


def sources(count: int) -> Addresses:
    """``count`` loopback addresses (127.1.0.0 and on) in network byte order, for the C code."""
    return (np.uint32(0x7F010000) + np.arange(count, dtype=np.uint32)).astype(">u4").view(np.uint32)


class PathEnds:
    """Both ends of a path through a relay: a sender connected to it, and the sink behind it.

    All datagrams are numbered consecutively from 0.
    """

    def __init__(self) -> None:
        self._load = _load()
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

        The burst may end although ``slack`` last datagrams have not arrived. Datagrams are sent from
        the ``addresses`` in turn, if there are any (:func:`sources`).

        Returns:
            A ``struct burst`` of ``load.c``: time, number of the last arrival, number of arrivals.
        """
        result = _FFI.new("struct burst *")
        senders = (_FFI.NULL, 0)
        if addresses is not None:
            senders = (_FFI.from_buffer("uint32_t[]", addresses), len(addresses))
        self._call("burst", self._first(count), count, relay, *senders, slack, result)
        return result

    def delays_ns(self, count: int, period_ns: int = 0) -> Nanoseconds:
        """Return the one-way delays of datagrams, negative for a missing one.

        They are sent every ``period_ns``, or one by one if it is 0.
        """
        delays_ns = np.empty(count, np.int64)
        function, period = ("pace", (period_ns,)) if period_ns else ("ping", ())
        self._call(function, self._first(count), count, *period, _FFI.from_buffer("int64_t[]", delays_ns))
        return delays_ns

    def _first(self, count: int) -> int:
        first, self._sent_count = self._sent_count, self._sent_count + count
        return first

    def _call(self, name: str, *arguments: object) -> None:
        function = getattr(self._load, f"load_{name}")
        if number := function(self.out.fileno(), self.sink.fileno(), *arguments):
            raise MeasurementError(f"{name}: {os.strerror(number)}")


class RelayKind(NamedTuple):
    """A kind of relay."""

    name: str
    command: Sequence[str]
    """With ``{port}`` and ``{to}`` for the ports on loopback from which and to which it relays."""
    lossy: bool = False
    """Whether it may lose datagrams."""


SOCAT = RelayKind("socat", (
    "socat", "-u", "-b", "2048", f"UDP4-RECV:{{port}},rcvbuf={4 * 2**20}",
    f"UDP4-SENDTO:{LOOPBACK}:{{to}}",
))  # fmt: skip
_MODES = {"segment": "segments", "names": "senders' addresses", "paths": "a socket per client"}


def c_relay(*words: str) -> RelayKind:
    """Return ``relay.c`` in one of its modes, ``segment``, ``names`` and ``paths``."""
    name = ", ".join(["C relay", *(_MODES[word] for word in words)])
    return RelayKind(name, (compile_program("relay.c"), "{port}", "{to}", *words))


def our_relay(name: str, words: str, *, lossy: bool = True) -> RelayKind:
    """Return ``python -m netem`` with impairments in tc's words and further options."""
    ends = ("--listen", LOOPBACK + ":{port}", "--to", LOOPBACK + ":{to}")
    return RelayKind(name, (sys.executable, "-m", "netem", *ends, *words.split()), lossy)


@dataclass
class LoadedRelay:
    """A running relay with its sender and sink."""

    kind: RelayKind
    process: "subprocess.Popen[str]"
    ends: PathEnds
    burst_datagrams: int = 0
    """Length of a burst; 0 before the first one."""

    @property
    def cpu_s(self) -> float:
        """CPU time of all its threads so far."""
        tasks = Path(f"/proc/{self.process.pid}/task").glob("*/schedstat")
        return sum(int(task.read_text().split()[0]) for task in tasks) * 1e-9

    def burst(self, addresses: Addresses | None = None) -> Figures:
        """Send it one burst, from these addresses in turn if there are any.

        The first time, also determine the capacity of its buffer.

        Returns:
            ``per_s``: datagrams per second, received and decided until the last arrival, from its
            continuation on; ``cpu_us``: CPU time for each.
        """
        slack = _LOSSY_SLACK if self.kind.lossy else 0
        if not self.burst_datagrams:
            capacity = self.ends.burst(self.process.pid, _PROBE_DATAGRAMS, 0, addresses).last + 1
            self.burst_datagrams = min(BURST, capacity * 9 // 10)
        sent, before_s = self.burst_datagrams, self.cpu_s
        result = self.ends.burst(self.process.pid, sent, slack, addresses)
        cpu_s, decisions = self.cpu_s - before_s, result.last + 1
        if decisions <= 0 or decisions < sent - slack or (slack == 0 and result.received != sent):
            raise MeasurementError(f"of a burst of {sent} only {result.received} arrived")
        return {"per_s": decisions / result.wall_ns * 1e9, "cpu_us": cpu_s / sent * 1e6}


@contextmanager
def running(kind: RelayKind) -> Iterator[LoadedRelay]:
    """Run a relay on its core, between sender and sink."""
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        port = int(probe.getsockname()[1])
    with closing(PathEnds()) as ends, ExitStack() as stack:
        command = [word.format(port=port, to=ends.sink.getsockname()[1]) for word in kind.command]
        command[0] = program_path(command[0], kind.name)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        os.sched_setaffinity(process.pid, {RELAY_CORE})
        with suppress(PermissionError):
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(1))
        stack.callback(process.communicate)
        stack.callback(process.kill)
        wait_for(lambda: process.poll() is not None or _is_bound(port))
        if process.poll() is not None:
            raise MeasurementError(f"{kind.name} does not listen: {process.communicate()[1].strip()}")
        ends.out.connect((LOOPBACK, port))
        yield LoadedRelay(kind, process, ends)


def _is_bound(port: int) -> bool:
    """Whether a UDP socket of this host has a port."""
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    return any(int(line.split()[1].rpartition(":")[2], 16) == port for line in lines)


@contextmanager
def started(*kinds: RelayKind) -> Iterator[tuple[Rounds, dict[str, LoadedRelay]]]:
    """Run relays within the context; the rounds say which ones did not start, and why."""
    rounds, relays = Rounds(), dict[str, LoadedRelay]()
    with ExitStack() as stack:
        for kind in kinds:
            try:
                relays[kind.name] = stack.enter_context(running(kind))
            except MeasurementError as error:
                rounds.missing[kind.name] = str(error)
        yield rounds, relays

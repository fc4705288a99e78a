"""CPU time per datagram of a run's emulator with its record: in the core, and driven from Python.

Bursts of datagrams wait at the emulator's socket; it relays them by the lane example's settings.
The time of its own thread counts: kernel, decisions, rows of the record.
"""

import argparse
import select
import socket
import time
from collections.abc import Callable
from contextlib import closing, suppress

from benchmarks._report import Benchmark, Goal, Peer, Row, median, say
from cosim.cli import find_scenario
from netem.channel import channel_of
from netem.engine.run_network import RunNetwork
from netem.run_relay import CoreShell, RelayShell
from noack.config.resolution import resolve, tables_of
from noack.config.scenario_file import load
from noack.core.clock import RunClock
from noack.protocol.machine_interface import BEGINNING, Record
from noack.protocol.record_tables import OWNER
from noack.runtime.telemetry import TelemetryBuffer
from noack.runtime.udp_sockets import bind

ROUNDS, BURSTS, BURST = 7, 20, 500
_SIZE_BYTES = 72
_PERIOD_NS = 1_000_000

Relay = Callable[[int], None]
"""Relays until this many datagrams have been received in all."""


class Loop:
    """The sockets around an emulator, and what both emulators need."""

    def __init__(self, endpoint: socket.socket, controller: socket.socket, sensor: socket.socket):
        self.scenario = resolve(load(find_scenario("lane_following"), ()))
        self.endpoint, self.ways = endpoint, [(sensor.getsockname(), controller.getsockname())]
        self.clock = RunClock(time.monotonic_ns())
        tables = {table: dtype for table, dtype in tables_of(self.scenario).items()
                  if OWNER[table] == "netem"}  # fmt: skip
        self.telemetry = TelemetryBuffer(tables, lambda table, header, payload: None)

    def core(self) -> tuple[RelayShell, Relay]:
        """Open the emulator in the core."""
        network = RunNetwork(self.scenario, BEGINNING)
        shell = CoreShell(self.endpoint, self.ways, network=network, clock=self.clock, spin_us=0.0)
        shell.tend(0)

        def relay(count: int) -> None:
            while network.received[0] < count:
                network.drive(self.clock.now_ns() + _PERIOD_NS, self.telemetry)

        return shell, relay

    def python(self) -> tuple[RelayShell, Relay]:
        """Open the emulator that is driven from Python, as by :mod:`.real_time_loop`."""
        channel, shell = channel_of(self.scenario), RelayShell(self.endpoint, self.ways)

        def relay(count: int) -> None:
            while channel.links[0].counters.received < count:
                readable, _, _ = select.select(shell.watched, (), (), 0.001)
                message = shell.receive(readable[0]) if readable else None
                if message is None:
                    continue
                for output in channel.handle(message, self.clock.now_ns()):
                    if isinstance(output, Record):
                        self.telemetry.append(output)
                    else:
                        shell.send(output)  # type: ignore[arg-type]

        return shell, relay


def cpu_us(kind: str) -> float:
    """Return the CPU microseconds per datagram of one round."""
    with closing(bind(0, "")) as endpoint, closing(bind(0, "")) as to, closing(bind(0, "")) as by:
        shell, relay = getattr(Loop(endpoint, to, by), kind)()
        used_ns = 0
        with closing(shell):
            for burst in range(1, BURSTS + 1):
                for _ in range(BURST):
                    by.sendto(bytes(_SIZE_BYTES), endpoint.getsockname())
                began_ns = time.thread_time_ns()
                relay(burst * BURST)
                used_ns += time.thread_time_ns() - began_ns
                with suppress(BlockingIOError):
                    while True:
                        to.recv(_SIZE_BYTES)
    return used_ns / (BURSTS * BURST) / 1e3


def measure(options: argparse.Namespace) -> list[Row]:
    """Compare both in turn."""
    say("emulator of a run")
    rounds = [(cpu_us("core"), cpu_us("python")) for _ in range(ROUNDS)]
    ours, plain = (median(one) for one in zip(*rounds, strict=True))
    peer = Peer("driven from Python", plain)
    return [Row("datagram, with sockets and record", ours, "µs CPU", peer, Goal("<=", 0.25))]


BENCHMARK = Benchmark("emulator", "Emulator of a run", measure)

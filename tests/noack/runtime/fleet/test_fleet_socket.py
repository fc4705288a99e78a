"""The socket of a fleet: which datagrams it reads, and which the fleet reads."""

import socket
import time
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from sensor_node.sensor_arrays import SENSOR_FLEET

from noack.config.resolution import loop_of, resolved_loops
from noack.config.scenario_file import validate
from noack.core.clock import RunClock
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.runtime import udp_sockets
from noack.runtime.fleet.compiled_driver import compiled_driver
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.fleet.fleet_socket import FLEET_BUFFER_BYTES, FleetSocket
from noack.runtime.peer_sockets import enlarge_buffer, has_peer_sockets, open_beside
from noack.runtime.udp_sockets import bind

RUN_ID, KEY = 7, bytes(range(32))
EARLY = 9000
"""More than the socket reads in one turn during the run."""


class Rows:
    """Counts rows by table."""

    def __init__(self) -> None:
        self.count = 0

    def append(self, record: Record) -> None:
        raise AssertionError

    def extend_table(self, table: str, rows: Any) -> None:
        self.count += len(rows)

    def notice(self, notice: Notice) -> None:
        raise AssertionError

    def flush(self) -> None:
        raise AssertionError


pytestmark = pytest.mark.skipif(not has_peer_sockets(), reason="the system has no peer sockets")


class Plant:
    """Sends measurements of a loop to a fleet of sensors, and counts what Python reads of them."""

    def __init__(self, content: dict[str, Any], patch: pytest.MonkeyPatch) -> None:
        content["loops"] = [{"name": "a", "count": 4}]
        run = validate(content, "here")
        loops = resolved_loops(run)
        parts = SENSOR_FLEET.parts_of(loops)
        assert parts is not None
        self.fleet = CompiledFleet("sensor", SENSOR_FLEET, parts, run, loops, RUN_ID, KEY)
        self.fleet.use(compiled_driver(SENSOR_FLEET, self.fleet.arguments))
        self.endpoint, self._own = bind(0, ""), bind(0, "")
        enlarge_buffer(self.endpoint, FLEET_BUFFER_BYTES)
        self._encoder, self._loop, self._sent = Encoder(RUN_ID, KEY), loops[0], 0
        self.read_by_python = 0
        """Number of datagrams."""
        self.at_each_read = 0
        """Datagrams that are sent whenever Python reads one."""
        judge = FleetSocket.judge

        def counted(channel: FleetSocket, data: bytes, source: tuple[str, int]) -> None:
            self.read_by_python += 1
            assert self.read_by_python <= EARLY, "Python reads on and on"
            self.send(self.at_each_read)
            judge(channel, data, source)

        patch.setattr(FleetSocket, "judge", counted)

    def send(self, count: int) -> None:
        for k in range(self._sent, self._sent + count):
            t_ns = k * self._loop.timing.measurement_period_ns
            message = Message(Flow.MEASUREMENT, k, t_ns, np.zeros(loop_of(self._loop).n), 3)
            self._own.sendto(self._encoder.encode(message), self.endpoint.getsockname())
        self._sent += count

    def channel(self, clock: RunClock) -> FleetSocket:
        own = self._own.getsockname()
        return FleetSocket(
            self.endpoint, self.fleet, Flow.UPDATE, clock=clock, source=own, destination=own
        )

    def let_the_fleet_read(self, clock: RunClock) -> int:
        """Let it accept all that was sent; return the number of rows."""
        sink = Rows()
        while self.fleet.accepted < self._sent:
            self.fleet.drive(clock.now_ns() + 1_000_000, sink)
        assert not any(self.fleet.rejected.values())
        return sink.count

    def close(self) -> None:
        self.endpoint.close()
        self._own.close()


def test_early_datagrams_are_all_processed_first_and_later_ones_by_the_fleet(
    content: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = RunClock(time.monotonic_ns(), 1.0)
    with closing(Plant(content, monkeypatch)) as plant:
        plant.send(EARLY)
        with closing(plant.channel(clock)) as channel:
            plant.send(100)  # into the peer's socket
            rows = len(channel.tend(0))
            assert plant.read_by_python == EARLY
            plant.send(EARLY - 100)
            channel.tend(0)
            assert plant.read_by_python == EARLY
            assert rows + plant.let_the_fleet_read(clock) == 2 * EARLY


def test_python_reads_only_what_came_while_the_socket_was_opened(
    content: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Datagrams may come faster than Python reads them: it must not read until there are none."""
    clock = RunClock(time.monotonic_ns(), 1.0)
    with closing(Plant(content, monkeypatch)) as plant:

        def opened(*given: Any) -> tuple[socket.socket, ...]:
            beside = open_beside(*given)
            plant.send(50)
            return beside

        monkeypatch.setattr(udp_sockets, "open_beside", opened)
        with closing(plant.channel(clock)) as channel:
            plant.at_each_read = 1
            rows = len(channel.tend(0))
            assert 50 <= plant.read_by_python < EARLY
            plant.at_each_read = 0
            assert rows + plant.let_the_fleet_read(clock) == 50 + plant.read_by_python

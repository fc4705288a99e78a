"""The socket of a fleet: which datagrams it reads, and which the fleet reads."""

import time
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from noack.config.resolution import loop_of, resolved_loops
from noack.config.scenario_file import validate
from noack.core.clock import RunClock
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.runtime.fleet.compiled_driver import compiled_driver
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.fleet.fleet_socket import FLEET_BUFFER_BYTES, FleetSocket
from noack.runtime.peer_sockets import has_peer_sockets
from noack.runtime.udp_sockets import bind, enlarge_buffer
from sensor_node.sensor_arrays import SENSOR_FLEET

RUN_ID, KEY = 7, bytes(range(32))
EARLY = 9000
"""More than the socket reads in one turn during the run (512 times 8)."""


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


@pytest.mark.skipif(not has_peer_sockets(), reason="the system has no peer sockets")
def test_early_datagrams_are_all_processed_first_and_later_ones_by_the_fleet(
    content: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    content["loops"] = [{"name": "a", "count": 4}]
    run = validate(content, "here")
    loops = resolved_loops(run)
    parts = SENSOR_FLEET.parts_of(loops)
    assert parts is not None
    fleet = CompiledFleet("sensor", SENSOR_FLEET, parts, run, loops, RUN_ID, KEY)
    fleet.use(compiled_driver(SENSOR_FLEET, fleet.arguments))
    read_by_python = []
    judge = FleetSocket.judge
    monkeypatch.setattr(
        FleetSocket, "judge", lambda *given: [read_by_python.append(1), judge(*given)][1]
    )
    encoder, period_ns = Encoder(RUN_ID, KEY), loops[0].timing.measurement_period_ns
    with closing(bind(0, "")) as endpoint, closing(bind(0, "")) as plant:
        enlarge_buffer(endpoint, FLEET_BUFFER_BYTES)

        def send(first: int, end: int) -> None:
            for k in range(first, end):
                message = Message(
                    Flow.MEASUREMENT, k, k * period_ns, np.zeros(loop_of(loops[0]).n), 3
                )
                plant.sendto(encoder.encode(message), endpoint.getsockname())

        send(0, EARLY)
        clock, own = RunClock(time.monotonic_ns(), 1.0), plant.getsockname()
        with closing(
            FleetSocket(endpoint, fleet, Flow.UPDATE, clock=clock, source=own, destination=own)
        ) as channel:
            send(EARLY, EARLY + 100)  # into the peer's socket
            rows = len(channel.tend(0))
            assert len(read_by_python) == EARLY
            send(EARLY + 100, 2 * EARLY)
            channel.tend(0)
            assert len(read_by_python) == EARLY
            sink = Rows()
            while fleet.accepted < 2 * EARLY:
                fleet.drive(clock.now_ns() + 1_000_000, sink)
            assert rows + sink.count == 2 * EARLY
            assert not any(fleet.rejected.values())

"""The channel of a run's emulator accepts the peers' datagrams only, and counts the others."""

import socket
import time
from contextlib import closing
from pathlib import Path

import numpy as np

from netem.run_network import NetworkChannel, RunNetwork
from noack.core.clock import RunClock
from noack.protocol.machine_interface import BEGINNING, Notice
from noack.protocol.record_tables import NETEM_PACKET, NETEM_RELEASE, OWNER
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.runtime.address import text_of
from noack.runtime.real_time_loop import run_loop
from noack.runtime.telemetry import TelemetryBuffer
from noack.runtime.udp_sockets import bind
from noack.scenario.resolution import resolve, tables_of
from noack.scenario.scenario_file import load
from tests.netem.engine.relays import PATIENCE_S, Received, drain, endpoints, name_of

SCENARIO = resolve(
    load(
        Path(__file__).parents[2] / "scenarios" / "lane_following.toml",
        ['network.loss={model="lossless"}', "speed=2.0",
         'network.impairments=[{kind="delay", delay_s=0.001}]'],
    )
)  # fmt: skip
EARLY, LATER, FOREIGN = 3, 700, 5


def update(sequence: int, loop: int = 0) -> bytes:
    message = Message(Flow.UPDATE, sequence, 0, np.zeros(2), loop)
    return Encoder(1, bytes(32)).encode(message)


def test_early_and_later_datagrams_are_relayed_and_foreign_ones_counted() -> None:
    published: list[tuple[str, bytes]] = []
    tables = {table: dtype for table, dtype in tables_of(SCENARIO).items()
              if OWNER[table] == "netem"}  # fmt: skip
    telemetry = TelemetryBuffer(tables, lambda table, _, rows: published.append((table, rows)))
    with (
        endpoints(*["127.0.0.1"] * 3) as (sensor, controller, foreign),
        closing(bind(0, "test")) as endpoint,
    ):
        sensor_name, foreign_name = text_of(name_of(sensor)), text_of(name_of(foreign))
        for number in range(EARLY):  # before there is a socket for the sensor
            sensor.sendto(update(number), endpoint.getsockname())
        for _ in range(FOREIGN):
            foreign.sendto(b"?", endpoint.getsockname())
        clock = RunClock(time.monotonic_ns(), SCENARIO.speed)
        machine, shell = opened(endpoint, controller, sensor, clock)
        received: Received = []
        sent = iter(range(EARLY, EARLY + LATER))

        def news(now_ns: int) -> list[Notice]:
            for _ in range(100):
                if (number := next(sent, None)) is not None:
                    sensor.sendto(update(number), endpoint.getsockname())
            return []

        def stop() -> bool:
            received.extend(drain(controller))
            late = clock.now_ns() > PATIENCE_S * 1e9 * SCENARIO.speed
            return late or len(received) == EARLY + LATER

        with closing(shell):
            run_loop(machine, shell, clock, telemetry, end_ns=None, stop=stop, news=news)
            shell.finish(clock.now_ns(), telemetry)
            telemetry.flush()
            report = shell.report()
    assert [data for data, _ in received] == [update(number) for number in range(EARLY + LATER)]
    assert {text_of(source) for _, source in received} == {report["local"]}
    assert report["sent"] == EARLY + LATER
    assert report["send_errors"] == {}
    assert report["rejected"] == {"source": FOREIGN}
    assert report["received_from"] == {sensor_name: EARLY + LATER, foreign_name: FOREIGN}
    counts = {table: sum(len(rows) for one, rows in published if one == table) for table in tables}
    for table in (NETEM_PACKET, NETEM_RELEASE):
        assert counts[table] == (EARLY + LATER) * tables[table].itemsize


def opened(
    endpoint: socket.socket,
    controller: socket.socket,
    sensor: socket.socket,
    clock: RunClock,
    loops: int = 1,
) -> tuple[RunNetwork, NetworkChannel]:
    ways = [(name_of(sensor), name_of(controller))]
    network = RunNetwork(SCENARIO, BEGINNING, loops)
    return network, NetworkChannel(endpoint, ways, network=network, clock=clock, loops=loops)

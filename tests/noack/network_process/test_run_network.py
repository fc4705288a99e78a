"""The network of a run, with sockets, does what the network without sockets does that replays it."""

import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import islice
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.shipped_files import find_shipped
from netem.core.address import address_text
from netem.core.clock import RunClock
from netem.core.packet_rows import NETEM_PACKET, NETEM_RELEASE
from netem.impairments.link_settings import LinkSettings
from noack.machines.run_channel import Datagram, channel_of
from noack.network_process.run_network import NetworkSockets, RunNetwork
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import Notice, Record
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.runtime.counting_sockets import bind
from noack.runtime.drivers.real_time_loop import run_loop
from noack.runtime.telemetry import TelemetryBuffer
from noack.scenario.resolution import resolve, tables_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from tests.netem.impairments import any_link_settings as any_settings
from tests.netem.relay.relays import PATIENCE_S, Received, drain, endpoints, name_of
from tests.noack.machines.stepped_channel import SteppedChannel

NEVER_NS = 2**61
Arrival = tuple[int, int, int]
"""Time since the arrival before, size, and flow."""
arrivals = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 10_000, 1_000_000, 30_000_000]) | st.integers(0, 10**8),
        st.sampled_from([32, 33, 72, 1472, 9000]),
        st.integers(0, 1),
    ),
    min_size=1, max_size=60,
)  # fmt: skip


class ComparedNetworks:
    """The network with sockets and the one without; each input is given to both."""

    def __init__(self, resolved: Any, sockets: list[socket.socket], loops: int) -> None:
        self.loops = loops
        self.channel = SteppedChannel(channel_of(resolved, loops=self.loops))
        self.sockets: Any = RunNetwork(resolved, self.loops)
        sender, sensor, plant, self._controller, *receivers = sockets
        peers = {name_of(sensor): receivers[0], name_of(self._controller): receivers[1]}
        self._other = plant if Flow.ACTUATION in resolved.network.flows else sensor
        # A clock that stays far behind the times that the test passes.
        clock = RunClock(time.monotonic_ns() + NEVER_NS)
        ends = name_of(self._controller), name_of(self._other)
        sender.connect(ends[0])
        self.sockets.open(clock, sender, peers, ends)
        self._expected: dict[int, list[bytes]] = {0: [], 1: []}
        self.rows: list[Record] = []

    def arrive(self, data: bytes, flow: int, now_ns: int) -> None:
        rows = self._release_channel(now_ns)
        rows += self._forwarded(self.channel.handle(Datagram(flow, data), now_ns))
        self._compare(rows, self.sockets.handle(Datagram(flow, data), now_ns))

    def release(self, now_ns: int) -> None:
        self._compare(self._release_channel(now_ns), self.sockets.on_timer(now_ns))

    def received(self) -> tuple[list[bytes], list[bytes]]:
        """Return what the two receivers should have received; check that they did."""
        drained = {0: drain(self._controller), 1: drain(self._other)}
        assert {flow: [data for data, _ in drained[flow]] for flow in drained} == self._expected
        return self._expected[0], self._expected[1]

    def _release_channel(self, now_ns: int) -> list[Any]:
        rows = []
        while (due_ns := self.channel.next_deadline_ns()) is not None and due_ns <= now_ns:
            rows += self._forwarded(self.channel.on_timer(now_ns))
        return rows

    def _forwarded(self, outputs: Any) -> list[Any]:
        for output in outputs:
            if isinstance(output, Datagram):
                self._expected[output.flow // self.loops].append(output.data)
        return [output for output in outputs if not isinstance(output, Datagram)]

    def _compare(self, expected: Any, outputs: Any) -> None:
        assert list(outputs) == list(expected)
        assert self.sockets.next_deadline_ns() == self.channel.next_deadline_ns()
        self.rows += expected


@contextmanager
def compared(resolved: Any, loops: int = 1) -> Iterator[ComparedNetworks]:
    with endpoints(*["127.0.0.1"] * 6) as sockets:
        networks = ComparedNetworks(resolved, sockets, loops)
        with closing(networks.sockets):
            yield networks


def network(forward: LinkSettings, reverse: LinkSettings, *flows: Flow) -> SimpleNamespace:
    """Return what the networks read of a scenario."""
    links = (forward, reverse)
    network = SimpleNamespace(link=forward, flows=flows, link_of=lambda flow: links[flows.index(flow)])
    return SimpleNamespace(network=network, seeds=SimpleNamespace(loss=0))


CROSSING = st.sampled_from([
    (Flow.UPDATE,), (Flow.UPDATE, Flow.ACKNOWLEDGEMENT), (Flow.UPDATE, Flow.ACTUATION)
])  # fmt: skip
"""What crosses the network."""


@settings(max_examples=40)
@given(
    any_settings.harsh, any_settings.harsh, CROSSING, arrivals,
    st.sampled_from([1, 1, 2, 200]),
)  # fmt: skip
def test_the_network_of_a_run_gives_the_rows_and_datagrams_of_its_replay(
    forward: LinkSettings,
    reverse: LinkSettings,
    crossing: tuple[Flow, ...],
    steps: list[Arrival],
    loops: int,
) -> None:
    """The two directions have 2 · ``loops`` flows in all, which the header tells apart."""
    now_ns = 0
    with compared(network(forward, reverse, *crossing), loops) as networks:
        for number, (gap_ns, size, direction) in enumerate(steps):
            now_ns += gap_ns
            if gap_ns % 3 == 1:
                networks.release(now_ns - gap_ns // 2)
            loop = number * 67 % loops
            head = bytes(6) + loop.to_bytes(2, "little") + bytes(24)
            data = (head + number.to_bytes(4, "big") * (size // 4))[:size]
            networks.arrive(data, loop + loops * direction * (len(crossing) == 2), now_ns)
        for data in (bytes(31), bytes(6) + loops.to_bytes(2, "little") + bytes(24)):
            networks.sockets.handle(Datagram(0, data), now_ns)
        networks.release(NEVER_NS)
        networks.received()
        assert networks.sockets.of_no_loop == 2
    inputs = [record.row[0] for record in networks.rows]
    assert inputs == list(range(len(inputs)))


class _Rows(list[Any]):
    def extend_table(self, table: str, rows: Any) -> None:
        self.extend(rows.tolist())


def test_arrival_is_when_the_datagram_reached_the_socket() -> None:
    """It is read later. The kernel's real-time clock may be adjusted by a millisecond meanwhile."""
    clock = RunClock(time.monotonic_ns() - 10**9, 0.25)
    resolved = network(LinkSettings(), LinkSettings(), Flow.UPDATE)
    with endpoints(*["127.0.0.1"] * 5) as (sender, sensor, controller, *receivers):
        peers = dict(zip((name_of(sensor), name_of(controller)), receivers, strict=True))
        with closing(RunNetwork(cast(Scenario, resolved))) as run_network:
            sender.connect(name_of(controller))
            run_network.open(clock, sender, peers, [name_of(controller)])
            for _ in range(20):  # a process that is stalled meanwhile cannot compare its clocks
                before_ns = clock.now_ns()
                sensor.sendto(bytes(32), name_of(receivers[0]))
                after_ns = clock.now_ns()
                time.sleep(0.05)
                rows, read_ns = _Rows(), clock.now_ns()
                while not rows:  # a machine that stalls may end it before it reads
                    run_network.drive(clock.now_ns() + 10**6, rows)
                ((_, _, t_ns, now_ns, *_),) = rows
                assert now_ns >= read_ns
                if before_ns - 10**6 <= t_ns <= after_ns + 10**6:
                    break
            else:
                pytest.fail("no arrival has the time at which it came")


def test_early_and_later_datagrams_are_relayed_and_foreign_ones_counted() -> None:
    """By the channel of the network: it accepts the peers' datagrams only."""
    early, later, foreign = 3, 700, 5
    published: Counter[str] = Counter()
    delay = 'network.impairments=[{kind="delay", delay_s=0.001}]'
    lossless = 'network.loss={model="lossless"}'
    scenario = resolve(load(find_shipped("lane_following", "scenarios"), ["speed=2.0", lossless, delay]))
    tables = {table: of for table, of in tables_of(scenario).items() if OWNER[table] == "netem"}
    telemetry = TelemetryBuffer(tables, lambda table, _, rows: published.update({table: len(rows)}))
    updates = (Message(Flow.UPDATE, k, 0, np.zeros(2), 0) for k in range(early + later))
    sent = [Encoder(1, bytes(32)).encode(update) for update in updates]
    with (
        endpoints(*["127.0.0.1"] * 3) as (sensor, controller, other),
        closing(bind(0, "test")) as endpoint,
    ):
        here = endpoint.getsockname()
        for data in sent[:early]:  # before there is a socket for the sensor
            sensor.sendto(data, here)
        for _ in range(foreign):
            other.sendto(b"?", here)
        clock = RunClock(time.monotonic_ns(), scenario.speed)
        network = RunNetwork(scenario)
        ends = [(name_of(sensor), name_of(controller))]
        received: Received = []
        waiting = iter(sent[early:])

        def send_batch(now_ns: int) -> list[Notice]:
            for data in islice(waiting, 100):
                sensor.sendto(data, here)
            return []

        def stop() -> bool:
            received.extend(drain(controller))
            late = clock.now_ns() > PATIENCE_S * 1e9 * scenario.speed
            return late or len(received) == len(sent)

        sockets = NetworkSockets(endpoint, ends, network=network, clock=clock, loops=1)
        with closing(sockets):
            run_loop(network, sockets, clock, telemetry, end_ns=None, stop=stop, external_inputs=send_batch)
            sockets.finish(clock.now_ns(), telemetry)
            telemetry.flush()
            report = sockets.report()
        senders = {address_text(name_of(source)) for source in (sensor, other)}
    assert [data for data, _ in received] == sent
    assert {address_text(source) for _, source in received} == {report["local"]}
    assert (report["sent"], report["send_errors"]) == (len(sent), {})
    assert report["rejected"] == {"source": foreign}
    assert report["received_from"].keys() == senders
    for table in (NETEM_PACKET, NETEM_RELEASE):
        assert published[table] == len(sent) * tables[table].itemsize

"""The network of a run, which itself waits for, receives and sends datagrams.

It decides as :mod:`noack.machines.channel` does, which replays its record: both call the core
(native/network/link.c), and both number these calls.
"""

import socket
from collections.abc import Mapping, Sequence

import numpy as np

from netem.core.address import Address, SocketName, packed_name
from netem.core.clock import RunClock
from netem.core.core_library import StructRows, core
from netem.core.packet_rows import NETEM_PACKET, NETEM_RELEASE, PACKET_ROW
from netem.core.udp_sockets import MAX_UDP_BYTES
from netem.impairments.link_settings import LinkSettings
from netem.relay.link_sockets import set_receive_timeout, stamp_arrivals
from netem.relay.relay_memory import RelayDirection, RelayMemory, name_array
from noack.machines.run_channel import Datagram, announce_change, due_settings, link_name
from noack.protocol.roles import Notice, Record
from noack.protocol.wire_format import loop_number
from noack.runtime.counting_sockets import CountingSockets, errors_by_text
from noack.runtime.drivers.real_time_loop import RecordSink, RowSink
from noack.scenario.parameter_changes import ChangeSchedule, ParameterChange
from noack.scenario.scenario import Scenario

_ROWS = 256
"""Rows of each table of the record that it keeps: as many as telemetry has in a batch."""
_AT_ONCE_NS = -(2**63)
"""Do what is due, and do not wait."""


class RunNetwork:
    """The network of a run: :meth:`drive` runs the core until the next housekeeping.

    Args:
        scenario: that of the run, which all loops share.
        loops: number of the run's loops; each datagram has the number of its loop.
    """

    def __init__(self, scenario: Scenario, loops: int = 1) -> None:
        self._loops = loops
        self._memory = RelayMemory(1, clients=loops, row_count=_ROWS)
        self._relay, clients = self._memory.core, self._memory.clients
        self._relay.loops = self._loops
        flows = np.arange(self._loops)
        clients["number"][flows] = clients["flow_row"][flows] = flows
        network = scenario.network
        links = [(network.link_of(flow), link_name(flow)) for flow in network.flows]
        self._directions: list[RelayDirection] = []
        if len(links) == 1:  # the relay has two directions; nothing arrives in the second
            links.append((LinkSettings(), "none"))
        for number, (settings, name) in enumerate(links):
            direction = RelayDirection(settings, scenario.seeds.loss, [name], self._relay.directions[number])
            for loop in range(self._loops):
                direction.start_flow(loop, number * self._loops + loop)
            self._directions.append(direction)
        self._schedule = ChangeSchedule(scenario, lambda changed: changed.network.link)
        self._reached_ns = -1

    def open(
        self,
        clock: RunClock,
        sender: socket.socket,
        receivers: Mapping[Address, socket.socket],
        destinations: Sequence[Address],
        spin_ns: int = 0,
    ) -> None:
        """Use these sockets from now on.

        Args:
            clock: the run's clock.
            sender: connected to the first destination.
            receivers: a socket connected to the source of each direction, the sensor first.
            destinations: where each direction ends.
            spin_ns: busy-wait for this time before a departure.
        """
        relay, clients = self._relay, self._memory.clients
        relay.spin_ns = spin_ns
        self.set_clock(clock)
        relay.sockets[1].fd = sender.fileno()
        for place, endpoint in zip((0, self._memory.first_path), receivers.values(), strict=False):
            stamp_arrivals(endpoint)
            if len(receivers) == 1:
                self._memory.wait_for_only(endpoint.fileno(), place, set_receive_timeout(endpoint))
            else:
                self._memory.watch(endpoint.fileno(), place)
        core.noack_relay_read_stamps(relay)
        self._sensor, name_bytes = packed_name(next(iter(receivers)))
        clients["name_bytes"][: self._loops] = name_bytes
        clients["name"][: self._loops] = name_array(self._sensor)
        core.noack_client_insert(relay, 0)
        sends = (core.NOACK_LINK_SOCKET, core.NOACK_DESTINATION_NAME)
        for direction, destination, addressing in zip(self._directions, destinations, sends, strict=False):
            direction.set_server(destination, addressing)
        # The kernel keeps other sources from connected sockets; what came before connect() is refused.
        self._directions[0].row.full = 1

    def set_clock(self, clock: RunClock) -> None:
        """Read the time as this clock does."""
        clock.set_core(self._relay.clock)

    def close(self) -> None:
        """Close what it opened."""
        self._memory.close()

    def next_deadline_ns(self) -> int | None:
        """Time of the next departure; None: nothing is in flight."""
        return self._relay.heap[0].due_ns if self._relay.heap_length else None

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Accept a change; see :meth:`noack.machines.channel.Channel.announce`."""
        return announce_change(self._relay, self._schedule, change, now_ns, self._reached_ns)

    def drive(self, until_ns: int, sink: RowSink) -> None:
        """Relay datagrams until a simulated time, and pass on the rows of the record."""
        while self._drive(until_ns) != core.NOACK_HOUSEKEEPING:
            self._pass_rows(sink)
        self._pass_rows(sink)

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Record]:
        """Process a datagram as if it had been received now; return its rows."""
        place = self._memory.first_path if message.flow >= self._loops else 0
        core.noack_relay_add_datagram(self._relay, place, self._sensor, message.data, len(message.data))
        return self.on_timer(now_ns)

    def on_timer(self, now_ns: int) -> Sequence[Record]:
        """Forward all datagrams that are due now; return their rows."""
        self._relay.read_ns = now_ns
        rows = _RowList()
        self.drive(_AT_ONCE_NS, rows)
        return sorted(rows, key=_first_entry)

    @property
    def received(self) -> Sequence[int]:
        """(2,) Datagrams received in each direction, without those of other sources."""
        return [direction.counters.received for direction in self._directions]

    @property
    def refused(self) -> int:
        """Datagrams of other sources."""
        return int(self._directions[0].row.refused)

    @property
    def of_no_loop(self) -> int:
        """Datagrams of the peers without the number of a loop of the run."""
        return int(self._relay.no_loop)

    @property
    def sent(self) -> int:
        """Datagrams and copies that were sent."""
        return sum(int(direction.counts_of("delays").sum()) for direction in self._directions)

    @property
    def send_errors(self) -> Sequence[int]:
        """Numbers of datagrams that could not be sent or stored, by errno."""
        counts = np.sum([direction.counts_of("errors") for direction in self._directions], axis=0)
        return [int(count) for count in counts]

    def _drive(self, until_ns: int) -> int:
        """Relay until the core returns, and do what it needs; return the reason."""
        relay, updates = self._relay, self._directions[0]
        reason: int = core.noack_relay_run(relay, until_ns)
        if reason == core.NOACK_CHANGE_DUE:
            for settings in due_settings(self._schedule, updates.settings, relay.now_ns):
                updates.change(settings, self._memory.latest_ns(0, updates.rows))
            self._relay.change_ns = self._schedule.next_ns
        elif reason == core.NOACK_HOUSEKEEPING:
            relay.no_memory = 0  # check again
        return reason

    def _pass_rows(self, sink: RowSink) -> None:
        packets, releases = self._memory.take_rows()
        if len(packets):
            self._reached_ns = int(packets["now_ns"][-1])
            sink.extend_table(NETEM_PACKET, packets.view(PACKET_ROW))
        if len(releases):
            sink.extend_table(NETEM_RELEASE, releases)


def _first_entry(record: Record) -> int:
    number = record.row[0]
    assert isinstance(number, int)
    return number


class _RowList(list[Record]):
    """A sink that keeps the rows."""

    def extend_table(self, table: str, rows: StructRows) -> None:
        """Add rows of a table."""
        self.extend(Record(table, row) for row in rows.tolist())


class NetworkSockets(CountingSockets):
    """The sockets of a network in the core, which receives the peers' datagrams and sends itself.

    Args:
        endpoint: the process's socket.
        routes: source and destination of each direction.
        network: the network; a datagram's flow is that of :mod:`noack.machines.channel`.
        clock: the run's clock.
        spin_ns: busy-wait for this time before a departure.
        loops: number of loops.

    Raises:
        PeerError: the system refused a socket for a peer.
    """

    most_bytes = MAX_UDP_BYTES

    def __init__(
        self,
        endpoint: socket.socket,
        routes: Sequence[tuple[Address, Address]],
        *,
        network: RunNetwork,
        clock: RunClock,
        spin_ns: int = 0,
        loops: int = 1,
    ) -> None:
        self._directions = {source: number for number, (source, _) in enumerate(routes)}
        destinations = [destination for _, destination in routes]
        super().__init__(endpoint, destinations, list(self._directions))
        self._loops = loops
        self._unknown_sources = self._of_no_loop = 0
        self._network, self._passed_on = network, [0, 0]
        receivers = dict(zip(self._directions, self.peer_sockets, strict=True))
        network.open(clock, self.senders[0], receivers, destinations, spin_ns)

    def take(self, data: bytes, source: SocketName, now_ns: int, sink: RecordSink) -> None:
        """Pass on a datagram that a peer sent before its socket was open; count others."""
        direction = self._directions.get(source[:2])
        loop = loop_number(data)
        if direction is None:
            self._unknown_sources += 1
        elif loop is None or loop >= self._loops:
            self._of_no_loop += 1
        else:
            self._passed_on[direction] += 1
            message = Datagram(direction * self._loops + loop, data)
            for record in self._network.handle(message, max(now_ns, 0)):
                sink.append(record)

    def report(self) -> dict[str, object]:
        """Return the counters for the run's summary."""
        network = self._network
        for source, direction in self._directions.items():
            received = network.received[direction] - self._passed_on[direction]
            self.count_received(source, received)
        rejected = {
            "source": self._unknown_sources + network.refused,
            "loop": self._of_no_loop + network.of_no_loop,
        }
        return super().report() | {
            "sent": network.sent,
            "send_errors": errors_by_text(network.send_errors),
            "rejected": self.rejected(rejected),
        }

    def close(self) -> None:
        """Close the sockets that it opened itself."""
        super().close()
        self._network.close()

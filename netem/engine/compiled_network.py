"""The network of a run as compiled code, which itself waits for, receives and sends datagrams.

It decides as :mod:`netem.link_machine` does, which replays its record: both call the core
(native/link.c), and both number these calls.
"""

import ctypes
import socket
from collections.abc import Mapping, Sequence

import numpy as np

from netem.engine.batched_directions import BatchedDirection
from netem.engine.epoll_object import Epoll
from netem.engine.pump import pump_layout
from netem.engine.pump.client_table import insert
from netem.engine.pump.pump_layout import Array
from netem.engine.pump_memory import PumpMemory
from netem.engine.relay_sockets import stamp_arrivals
from netem.link_machine import Datagram, at_start, due_settings, link_name
from noack.config.parameter_changes import ChangeSchedule, ParameterChange
from noack.config.scenario import Scenario
from noack.core.clock import RunClock
from noack.core.core_library import dtype_of
from noack.impairments.link_settings import LinkSettings
from noack.protocol.machine_interface import Notice, Record, Start
from noack.protocol.record_tables import (
    NETEM_PACKET,
    NETEM_RELEASE,
    NETEM_SETTING,
    PACKET_HEAD_BYTES,
)
from noack.runtime.address import Address
from noack.runtime.native.object_code import NativeFunction
from noack.runtime.native.socket_structs import packed_name
from noack.runtime.real_time_loop import RowSink

_ROWS = 256
"""Rows of each table of the record that the pump keeps: as many as telemetry has in a batch."""
_PACKET_ROW = np.dtype(
    [
        (name, f"V{PACKET_HEAD_BYTES}" if name == "head" else "<i8")
        for name in pump_layout.PACKET_ROW.names or ()
    ]
)
_PAST_NS = -(2**62)
_NEVER_NS = 2**63 - 1


class CompiledNetwork:
    """A machine that also drives itself between two turns of housekeeping.

    Args:
        resolved: the resolved scenario.
        start: where in the run it begins.
        run_pump: the pump, from :mod:`netem.engine.native_pump`.
        loops: number of the run's loops; None in a run of one loop without numbers.
    """

    def __init__(
        self, resolved: Scenario, start: Start, run_pump: NativeFunction, loops: int | None = None
    ) -> None:
        self._run_pump, self._loops = run_pump, loops or 1
        self._memory = PumpMemory(1, segment=False, taps=0, row_count=_ROWS)
        while len(self._memory.memory.clients) < self._loops:
            self._memory.add_clients()
        pump, clients = self._memory.pump, self._memory.memory.clients
        pump["inputs"] = pump["first_number"] = start.first_number
        pump["loops"], pump["by_loop"] = self._loops, loops is not None
        flows = np.arange(self._loops)
        clients["number"][flows] = clients["place"][flows] = flows
        network = resolved.network
        links = [(network.link_of(flow), link_name(flow)) for flow in network.flows]
        self._directions: list[BatchedDirection] = []
        if len(links) == 1:  # the pump has two directions; nothing arrives in the second
            links.append((LinkSettings(), "none"))
        for number, (settings, name) in enumerate(links):
            first, names = at_start(settings, name, start)
            direction = BatchedDirection(
                first, resolved.seeds.loss, names, number, self._memory.memory,
                restarted=start.is_restart,
            )  # fmt: skip
            for loop in range(self._loops):
                direction.start_flow(loop, number * self._loops + loop)
            self._directions.append(direction)
        self._schedule = ChangeSchedule(resolved, lambda one: one.network.link)
        self._reached_ns = -1
        self._decisions = np.zeros(1, dtype_of("noack_decision"))
        self._epoll = Epoll()
        pump["epoll"], pump["sleeps"] = self._epoll.fileno(), not self._epoll.waits_by_ns()

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
            sender: an unconnected socket, which sends the updates.
            receivers: a socket connected to the source of each direction, the sensor first.
            destinations: where each direction ends.
            spin_ns: busy-wait for this time before a departure.
        """
        memory, pump = self._memory.memory, self._memory.pump
        pump["epoch_ns"], pump["speed"], pump["spin_ns"] = clock.epoch_ns, clock.speed, spin_ns
        memory.sockets["fd"][1] = sender.fileno()
        for place, endpoint in zip((0, self._memory.first_path), receivers.values(), strict=False):
            stamp_arrivals(endpoint)
            memory.sockets["fd"][place] = endpoint.fileno()
            self._epoll.add(endpoint.fileno(), place)
        pump["stamps"] = 1
        self._memory.read_controls()
        self._sensor, name_bytes = packed_name(next(iter(receivers)))
        memory.clients["name_bytes"][: self._loops] = name_bytes
        memory.clients["name"][: self._loops] = np.frombuffer(self._sensor, np.uint8)
        with np.errstate(over="ignore"):
            row = memory.clients.view(np.recarray)
            insert(memory.table, row, 0, np.frombuffer(self._sensor, np.int64))
        memory.directions["sends"] = pump_layout.DESTINATION_NAME
        for direction, destination in zip(memory.directions, destinations, strict=False):
            name, direction["name_bytes"] = packed_name(destination)
            direction["name"] = np.frombuffer(name, np.uint8)
        memory.directions["full"][0] = 1  # refuse other sources

    def close(self) -> None:
        """Close what it opened."""
        self._epoll.close()

    def next_deadline_ns(self) -> int | None:
        """Time of the next departure; None: nothing is in flight."""
        heap = self._memory.memory.heap
        return int(heap["release_ns"][0]) if self._memory.pump["heap"] else None

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Accept a change; see :meth:`netem.link_machine.Link.announce`."""
        pump = self._memory.pump
        outputs = self._schedule.announce(
            NETEM_SETTING, change, int(pump["inputs"]), now_ns, self._reached_ns
        )
        pump["inputs"] += 1
        self._set_change_time()
        return outputs

    def drive(self, until_ns: int, sink: RowSink) -> None:
        """Relay datagrams until a simulated time, and pass on the rows of the record."""
        while self._drive(until_ns) != pump_layout.HOUSEKEEPING:
            self._pass_rows(sink)
        self._pass_rows(sink)

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Record]:
        """Process a datagram as if it had been received now; return its rows."""
        memory, pump = self._memory.memory, self._memory.pump
        ctypes.memmove(int(memory.in_vectors["base"][0]), message.data, len(message.data))
        memory.in_headers["size_bytes"][0] = len(message.data)
        memory.in_headers["control_bytes"][0] = 0  # the arrival is unknown
        memory.in_names[0] = np.frombuffer(self._sensor, np.int64)
        pump["batch_socket"] = self._memory.first_path if message.flow >= self._loops else 0
        pump["batch_next"], pump["batch_end"], pump["ready"], pump["ready_next"] = 0, 1, 0, 0
        return self.on_timer(now_ns)

    def on_timer(self, now_ns: int) -> Sequence[Record]:
        """Forward all datagrams that are due now; return their rows."""
        self._memory.pump["read_ns"] = now_ns
        rows = _RowList()
        self.drive(_PAST_NS, rows)
        return sorted(rows, key=lambda record: int(record.row[0]))

    @property
    def received(self) -> Sequence[int]:
        """(2,) Datagrams received in each direction, without those of other sources."""
        return [one.counters.received for one in self._directions]

    @property
    def refused(self) -> int:
        """Datagrams of other sources."""
        return int(self._memory.memory.directions["refused"][0])

    @property
    def of_no_loop(self) -> int:
        """Datagrams of the peers without the number of a loop of the run."""
        return int(self._memory.pump["no_loop"])

    @property
    def sent(self) -> int:
        """Datagrams and copies that were sent."""
        return int(self._memory.memory.delays.sum())

    @property
    def send_errors(self) -> Mapping[int, int]:
        """Number of datagrams that could not be sent or stored, by errno."""
        counts = self._memory.memory.errors.sum(axis=0)
        return {error: int(counts[error]) for error in np.flatnonzero(counts).tolist()}

    def _drive(self, until_ns: int) -> int:
        """Run the pump until it returns, and do what it needs; return the reason."""
        one = self._directions[0]
        reason = self._run_pump(self._memory.memory, self._decisions, until_ns)
        if reason == pump_layout.CHANGE_DUE:
            now_ns = int(self._memory.pump["now_ns"])
            for settings in due_settings(self._schedule, one.settings, now_ns):
                one.change(settings, self._memory.latest_ns(0, one.rows))
            self._set_change_time()
        elif reason == pump_layout.STORE_FULL:
            self._memory.pump["no_memory"] = not self._memory.add_room()
        elif reason == pump_layout.HOUSEKEEPING:
            self._memory.pump["no_memory"] = 0  # check again
        return reason

    def _set_change_time(self) -> None:
        next_ns = self._schedule.next_ns
        self._memory.pump["change_ns"] = _NEVER_NS if next_ns is None else next_ns

    def _pass_rows(self, sink: RowSink) -> None:
        memory, pump = self._memory.memory, self._memory.pump
        packets = memory.packets[: pump["packet_rows"]].view(_PACKET_ROW)
        releases = memory.releases[: pump["release_rows"]]
        if len(packets):
            self._reached_ns = int(packets["now_ns"][-1])
            sink.extend_table(NETEM_PACKET, packets)
        if len(releases):
            sink.extend_table(NETEM_RELEASE, releases)
        pump["packet_rows"] = pump["release_rows"] = 0


class _RowList(list[Record]):
    """A sink that keeps the rows."""

    def extend_table(self, table: str, rows: Array) -> None:
        """Add rows of a table."""
        self.extend(Record(table, row) for row in rows.tolist())

"""The whole loop in virtual time: the four machines, datagrams in between, and no clock at all.

The machines, their messages and the rules of the wire are those of a live run; only the shell is
another one. What is sent arrives at once, except what the network between sensor and controller
holds back, so a simulated run is the live run of a machine that is never late. It depends on its
scenario alone and repeats bit for bit on the same machine.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from controller_node.controller import controller_of
from cosim.record.run_record import Rows, RunRecord
from netem.duplex_link import network_of
from netem.link_machine import Datagram
from noack.config.parameter_changes import (
    ParameterChange,
    ReconfigurableMachine,
    said_of,
    scheduled,
)
from noack.config.resolution import tables_of
from noack.config.scenario import Scenario
from noack.protocol.loop_protocol import PROTOCOLS, LoopProtocol
from noack.protocol.machine_interface import Machine, Notice, Record
from noack.protocol.record_tables import (
    ACKNOWLEDGEMENTS,
    NETEM_PACKET,
    NETEM_RELEASE,
    OWNER,
    PACKET_HEAD_BYTES,
    UPDATES,
    Fate,
)
from noack.protocol.topology import CHANGEABLE, LOOP_ROLES, RECORDER, ROUTES
from noack.protocol.wire_format import KEY_BYTES, Decoder, Encoder, Flow, Message
from noack.runtime.life_cycle import HORIZON
from plant_server.plant import plant_of
from sensor_node.sensor import sensor_of

Network = Callable[[bytes, int], int | None]
"""Takes an update's datagram at a time, in ns; says how long it takes, or None if it is lost."""

Progress = Callable[[int], None]
"""Is told the simulated time now and then, in ns."""

RUN_ID = 0
"""Stands in the datagrams of every simulated run, so that its record depends on the scenario alone.

There is nobody to keep out, so the key is no secret either."""
_KEY = bytes(KEY_BYTES)

_TIMER_RANKS = {"plant": 0, "netem": 1, "sensor": 3, "controller": 4}
_DATAGRAM_RANK = 2
_BATCH_ROWS = 4096
_HAPPENINGS_PER_WORD = 4096


class DecidedLink:
    """A link whose losses and delays are decided outside: by a pattern, an adversary, another run.

    Args:
        decide: the network's word on each datagram.
    """

    def __init__(self, decide: Network) -> None:
        self._decide = decide
        self._inputs = 0
        self._packets = 0
        self._newest = -1
        self._drop_run = 0
        self._in_flight: list[tuple[int, int, Datagram]] = []

    def next_deadline_ns(self) -> int | None:
        """When the next datagram arrives."""
        return self._in_flight[0][0] if self._in_flight else None

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Let a datagram out."""
        release_ns, packet, datagram = heapq.heappop(self._in_flight)
        stale = packet < self._newest
        self._newest = max(self._newest, packet)
        row = (self._inputs, packet, release_ns, now_ns, datagram.flow, 0, int(stale))
        self._inputs += 1
        return (datagram, Record(NETEM_RELEASE, row))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Take a datagram; return it if it survives and is not delayed."""
        delay_ns = self._decide(message.data, now_ns)
        self._drop_run = self._drop_run + 1 if delay_ns is None else 0
        fate = Fate.DROPPED if delay_ns is None else Fate.DELIVERED
        head = message.data[:PACKET_HEAD_BYTES].ljust(PACKET_HEAD_BYTES, b"\0")
        release_ns = -1 if delay_ns is None else now_ns + delay_ns
        row = (
            self._inputs, self._packets, now_ns, now_ns,
            message.flow, fate, self._drop_run, release_ns, -1, -1, len(message.data), head,
        )  # fmt: skip
        record = Record(NETEM_PACKET, row)
        packet = self._packets
        self._inputs += 1
        self._packets += 1
        if delay_ns == 0:
            self._newest = max(self._newest, packet)
            return (message, record)
        if delay_ns is not None:
            heapq.heappush(self._in_flight, (release_ns, packet, message))
        return (record,)


class Shuttle:
    """Carries datagrams between the four machines, in the order of virtual time.

    At the same time the plant's step comes first, then what the network has held back, then
    datagrams in the order in which they were sent, then the sensor's and the controller's timers.

    Args:
        machines: the machine of each role.
        entries: how many numbers a message of a flow carries.
        take: takes each row and notice, with the role that emitted it.
        protocol: whether updates are acknowledged.
    """

    def __init__(
        self,
        machines: Mapping[str, Machine[Any]],
        entries: Callable[[Flow], int],
        take: Callable[[str, Record | Notice], None],
        *,
        protocol: LoopProtocol = PROTOCOLS["none"],
    ) -> None:
        self.machines = machines
        self._take = take
        self._encoder = Encoder(RUN_ID, _KEY)
        self.decoders = {
            role: Decoder(leg.receives, entries(leg.receives), RUN_ID, _KEY)
            for role, leg in ROUTES.items()
            if role != "netem"  # which reads no payload
        }
        self.acknowledgements = Decoder(Flow.ACKNOWLEDGEMENT, 0, RUN_ID, _KEY)
        self._acknowledgement_routes = protocol.acknowledgement_routes
        self._timers = [
            (machines[role].next_deadline_ns, rank, role) for role, rank in _TIMER_RANKS.items()
        ]
        self._sent: deque[tuple[str, str, bytes]] = deque()
        self._now_ns = 0

    def run(self) -> Iterator[int]:
        """Drive the machines until nothing is due; yield the time after everything that happens."""
        while (following := self._next()) is not None:
            self._now_ns, rank, role = following
            if rank != _DATAGRAM_RANK:
                self._emit(role, self.machines[role].on_timer(self._now_ns))
            elif not self._receive(*self._sent.popleft()):
                continue
            yield self._now_ns

    def announce(self, changes: Sequence[ParameterChange]) -> None:
        """Tell every machine that can be changed of changes to come."""
        for role in CHANGEABLE:
            machine: ReconfigurableMachine[Any] = self.machines[role]  # type: ignore[assignment]
            for change in changes:
                self._emit(role, machine.announce(change, self._now_ns))

    def _next(self) -> tuple[int, int, str] | None:
        due = [
            (t_ns, rank, role)
            for deadline_ns, rank, role in self._timers
            if (t_ns := deadline_ns()) is not None
        ]
        if self._sent:
            due.append((self._now_ns, _DATAGRAM_RANK, ""))
        return min(due, default=None)

    def _receive(self, sender: str, role: str, data: bytes) -> bool:
        message: Datagram | Message | None
        if role == "netem":
            message = Datagram(ACKNOWLEDGEMENTS if sender == "controller" else UPDATES, data)
        elif (sender, role) == ("netem", "sensor"):
            message = self.acknowledgements.decode(data)
        else:
            message = self.decoders[role].decode(data)
        if message is None:
            return False
        self._emit(role, self.machines[role].handle(message, self._now_ns))
        return True

    def _emit(self, role: str, outputs: Sequence[Any]) -> None:
        for output in outputs:
            if isinstance(output, Record | Notice):
                self._take(role, output)
            else:
                forwarded = isinstance(output, Datagram)
                data = output.data if forwarded else self._encoder.encode(output)
                answers = output.flow == (ACKNOWLEDGEMENTS if forwarded else Flow.ACKNOWLEDGEMENT)
                routes = self._acknowledgement_routes if answers else {}
                to = routes.get(role, ROUTES[role].to)
                self._sent.append((role, to, data))


class _Gathered:
    """Rows and notices, as they come."""

    def __init__(self, types: Mapping[str, np.dtype[np.void]]) -> None:
        self._types = types
        self._rows: dict[str, list[tuple[Any, ...]]] = {table: [] for table in types}
        self._batches: dict[str, list[Rows]] = {table: [] for table in types}
        self.notices: list[dict[str, Any]] = []

    def take(self, role: str, output: Record | Notice) -> None:
        if isinstance(output, Notice):
            self.notices.append(output._asdict() | {"process": role})
            return
        rows = self._rows[output.table]
        rows.append(output.row)
        if len(rows) == _BATCH_ROWS:  # an array takes a fifth of the memory
            self._batch(output.table)

    def rows(self) -> dict[str, Rows]:
        for table in self._types:
            self._batch(table)
        return {table: np.concatenate(batches) for table, batches in self._batches.items()}

    def _batch(self, table: str) -> None:
        self._batches[table].append(np.array(self._rows[table], self._types[table]))
        self._rows[table].clear()


def simulate(
    resolved: Scenario, network: Network | None = None, progress: Progress | None = None
) -> RunRecord:
    """Run a scenario in virtual time, sampled as a live run samples.

    Args:
        resolved: the resolved scenario; its speed, ports and real-time settings play no part.
        network: decides each update's fate; by default the scenario's own network does what it
            would in a live run.
        progress: is told how far the run is.

    Returns:
        The record of the run; reports hold what applies: no sockets, no real-time settings.
    """
    if network is not None:
        resolved.coverage.require_unchanging()
    gathered = _Gathered(tables_of(resolved))
    machines: dict[str, Machine[Any]] = {
        "plant": plant_of(resolved),
        "sensor": sensor_of(resolved),
        "netem": network_of(resolved, forward=None if network is None else DecidedLink(network)),
        "controller": controller_of(resolved),
    }
    shuttle = Shuttle(
        machines, resolved.message_sizes.entries, gathered.take, protocol=resolved.protocol
    )
    changes = scheduled(resolved)
    shuttle.announce(changes)
    for change in changes:
        gathered.take(RECORDER, said_of(change))
    with np.errstate(all="ignore"):  # a loop that diverges has a record, too
        for happened, now_ns in enumerate(shuttle.run()):
            if progress is not None and happened % _HAPPENINGS_PER_WORD == 0:
                progress(now_ns)
    rows = gathered.rows()
    reports = {role: _report(role, rows, shuttle.decoders.get(role)) for role in LOOP_ROLES}
    if resolved.protocol.acknowledges:
        reports["sensor"]["channel"]["acknowledgements"] = shuttle.acknowledgements.report()
    notices = sorted(gathered.notices, key=lambda notice: int(notice["t_ns"]))
    return RunRecord(resolved, rows, notices, reports, "simulated")


def _report(role: str, rows: Mapping[str, Rows], decoder: Decoder | None) -> dict[str, Any]:
    channel: dict[str, Any] = {"rejected": {}}
    if decoder is not None:
        channel = decoder.report()
    owned = {table: len(found) for table, found in rows.items() if OWNER[table] == role}
    return {"ended": HORIZON, "channel": channel, "rows": owned}

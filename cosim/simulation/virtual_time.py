"""Simulates the whole loop in virtual time: the four machines and their datagrams, without a clock.

The machines, their messages and the protocol are those of a live run; only the shell differs. A
datagram arrives at the time of sending, unless the network between sensor and controller delays
it. So a simulated run equals a live run in which no deadline is missed. It depends on its scenario
alone and is bit-exactly repeatable on the same computer.
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
    change_notice,
    scheduled,
)
from noack.config.resolution import tables_of
from noack.config.scenario import Scenario
from noack.protocol.datagram_seal import KEY_BYTES
from noack.protocol.fleet import FleetDecoder
from noack.protocol.machine_interface import Machine, Notice, Record
from noack.protocol.record_tables import (
    NETEM_PACKET,
    NETEM_RELEASE,
    OWNER,
    PACKET_HEAD_BYTES,
    Fate,
)
from noack.protocol.topology import (
    CHANGEABLE,
    ENDS,
    LOOP_ROLES,
    PAPER,
    RECEIVES,
    RECORDER,
    receiver_of,
)
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message, loop_number
from noack.runtime.life_cycle import HORIZON
from plant_server.plant import plant_of
from sensor_node.sensor import sensor_of

Network = Callable[[bytes, int], int | None]
"""Maps an update's datagram and the current time, ns, to its delay, ns, or to None for a loss."""

Take = Callable[[str, Record | Notice], None]
"""Called with each row or notice and the role that emitted it."""

AnyDecoder = Decoder | FleetDecoder

Progress = Callable[[int], None]
"""Called from time to time with the simulated time, in ns."""

RUN_ID = 0
"""Run number in the datagrams of every simulated run: a record depends on the scenario alone.

A simulation receives no foreign traffic, so its key need not be secret."""
_KEY = bytes(KEY_BYTES)

_TIMER_RANKS = {"plant": 0, "netem": 1, "sensor": 3, "controller": 4}
_DATAGRAM_RANK = 2
_BATCH_ROWS = 4096
_HAPPENINGS_PER_WORD = 4096


class DecidedLink:
    """A link with given losses and delays: of a pattern, an adversary or another run."""

    def __init__(self, decide: Network) -> None:
        self._decide = decide
        self._inputs = 0
        self._packets = 0
        self._newest = -1
        self._drop_run = 0
        self._in_flight: list[tuple[int, int, Datagram]] = []

    def next_deadline_ns(self) -> int | None:
        """Return the time of the next arrival."""
        return self._in_flight[0][0] if self._in_flight else None

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Forward the next delayed datagram."""
        release_ns, packet, datagram = heapq.heappop(self._in_flight)
        stale = packet < self._newest
        self._newest = max(self._newest, packet)
        row = (self._inputs, packet, release_ns, now_ns, datagram.flow, 0, int(stale))
        self._inputs += 1
        return (datagram, Record(NETEM_RELEASE, row))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Decide on a datagram; return it if it is neither lost nor delayed."""
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

    Order at equal times: the plant's step, delayed datagrams from the network, datagrams in the
    order of sending, the timers of sensor and controller.

    Args:
        machines: the machine of each role.
        entries: length of a message's vector by flow, of each loop.
        take: called with each row or notice and the role that emitted it.
        network: what crosses the network.
    """

    def __init__(
        self,
        machines: Mapping[str, Machine[Any]],
        entries: Sequence[Callable[[Flow], int]],
        take: Take,
        *,
        network: Sequence[Flow] = PAPER,
    ) -> None:
        self.machines = machines
        self._take = take
        self._encoder = Encoder(RUN_ID, _KEY)
        self._loops = len(entries)
        self.decoders = {
            role: _decoder(flow, entries)
            for role, flow in RECEIVES.items()
            if role != "netem"  # netem reads no payload
        }
        self.acknowledgements = _decoder(Flow.ACKNOWLEDGEMENT, entries)
        self._network = network
        self._timers = [
            (machines[role].next_deadline_ns, rank, role) for role, rank in _TIMER_RANKS.items()
        ]
        self._sent: deque[tuple[str, str, bytes]] = deque()
        self._now_ns = 0

    def run(self) -> Iterator[int]:
        """Drive the machines until nothing is due; yield the time after each step."""
        while (following := self._next()) is not None:
            self._now_ns, rank, role = following
            if rank != _DATAGRAM_RANK:
                self._emit(role, self.machines[role].on_timer(self._now_ns))
            elif not self._receive(*self._sent.popleft()):
                continue
            yield self._now_ns

    def announce(self, changes: Sequence[ParameterChange]) -> None:
        """Announce parameter changes to every reconfigurable machine."""
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
            direction = [ENDS[flow].sender for flow in self._network].index(sender)
            message = Datagram(direction * self._loops + (loop_number(data) or 0), data)
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
                flow = self._network[output.flow // self._loops] if forwarded else output.flow
                self._sent.append((role, receiver_of(role, flow, self._network), data))


def _decoder(flow: Flow, entries: Sequence[Callable[[Flow], int]]) -> AnyDecoder:
    decoders = [
        Decoder(flow, of_flow(flow), RUN_ID, _KEY, loop=loop)
        for loop, of_flow in enumerate(entries)
    ]
    return decoders[0] if len(decoders) == 1 else FleetDecoder(decoders)


class Gathered:
    """Rows and notices, in the order in which they are emitted."""

    def __init__(
        self, types: Mapping[str, np.dtype[np.void]], batch_rows: int = _BATCH_ROWS
    ) -> None:
        self._types, self._batch_rows = types, batch_rows
        self._rows: dict[str, list[tuple[Any, ...]]] = {table: [] for table in types}
        self._batches: dict[str, list[Rows]] = {table: [] for table in types}
        self.notices: list[dict[str, Any]] = []

    def take(self, role: str, output: Record | Notice) -> None:
        """Take a row or a notice of a role."""
        if isinstance(output, Notice):
            self.notices.append(output._replace(loop=None).line() | {"process": role})
            return
        rows = self._rows[output.table]
        rows.append(output.row)
        if len(rows) == self._batch_rows:  # an array needs a fifth of the memory of a list
            self._batch(output.table)

    def sorted_notices(self) -> list[dict[str, Any]]:
        """The notices in the order of their times."""
        return sorted(self.notices, key=lambda notice: int(notice["t_ns"]))

    def rows(self) -> dict[str, Rows]:
        """Return all rows by table."""
        for table in self._types:
            self._batch(table)
        return {table: np.concatenate(batches) for table, batches in self._batches.items()}

    def _batch(self, table: str) -> None:
        self._batches[table].append(np.array(self._rows[table], self._types[table]))
        self._rows[table].clear()


def simulate(
    resolved: Scenario, network: Network | None = None, progress: Progress | None = None
) -> RunRecord:
    """Run a scenario in virtual time, with the sampling of a live run.

    Args:
        resolved: the resolved scenario; its speed, ports and real-time settings have no effect.
        network: decides the fate of each update; by default the scenario's own network, as in a
            live run.
        progress: called with the simulated time.

    Returns:
        The record of the run; its reports have no entries about sockets or real-time settings.
    """
    if network is not None:
        resolved.coverage.require_unchanging()
    gathered = Gathered(tables_of(resolved))
    machines: dict[str, Machine[Any]] = {
        "plant": plant_of(resolved),
        "sensor": sensor_of(resolved),
        "netem": network_of(resolved, forward=None if network is None else DecidedLink(network)),
        "controller": controller_of(resolved),
    }
    shuttle = Shuttle(
        machines, [resolved.message_sizes.entries], gathered.take, network=resolved.network.flows
    )
    drive(shuttle, resolved, gathered.take, progress)
    rows = gathered.rows()
    reports = reports_of(rows, shuttle, resolved)
    return RunRecord(resolved, rows, gathered.sorted_notices(), reports, "simulated")


def drive(
    shuttle: Shuttle, scenario: Scenario, take: Take, progress: Progress | None = None
) -> None:
    """Announce the scenario's changes, and drive the machines until nothing is due."""
    changes = scheduled(scenario)
    shuttle.announce(changes)
    for change in changes:
        take(RECORDER, change_notice(change))
    with np.errstate(all="ignore"):  # a diverging loop overflows and is recorded all the same
        for happened, now_ns in enumerate(shuttle.run()):
            if progress is not None and happened % _HAPPENINGS_PER_WORD == 0:
                progress(now_ns)


def reports_of(
    rows: Mapping[str, Rows], shuttle: Shuttle, scenario: Scenario, loop: int = 0
) -> dict[str, dict[str, Any]]:
    """Return the final report of each role, as of a loop."""
    decoders = {role: of_loop(one, loop) for role, one in shuttle.decoders.items()}
    reports = {role: _report(role, rows, decoders.get(role)) for role in LOOP_ROLES}
    if scenario.protocol.acknowledges:
        acknowledgements = of_loop(shuttle.acknowledgements, loop)
        reports["sensor"]["channel"]["acknowledgements"] = acknowledgements.report()
    return reports


def of_loop(decoder: AnyDecoder, loop: int) -> Decoder:
    """Return the decoder of a loop."""
    return decoder.decoders[loop] if isinstance(decoder, FleetDecoder) else decoder


def _report(role: str, rows: Mapping[str, Rows], decoder: Decoder | None) -> dict[str, Any]:
    channel: dict[str, Any] = {"rejected": {}}
    if decoder is not None:
        channel = decoder.report()
    owned = {table: len(found) for table, found in rows.items() if OWNER[table] == role}
    return {"ended": HORIZON, "channel": channel, "rows": owned}

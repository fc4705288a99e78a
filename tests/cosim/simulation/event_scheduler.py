"""The order of a simulation in plain Python: machines step by step, and encoded datagrams.

native/driver/virtual.c does the same with structures. Tests compare both; some replace a machine.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from cosim.record.run_record import RunRecord
from netem.channel import RUN_ID, Datagram, UserNetwork, channel_of
from noack.protocol.record_tables import NETEM_PACKET, NETEM_RELEASE, OWNER, Fate
from noack.protocol.roles import CHANGEABLE, ENDS, LOOP_ROLES, RECEIVES, RECORDER, Notice, Record, receiver_of
from noack.protocol.wire_format import KEY_BYTES, Encoder, Flow, loop_number
from noack.runtime.life_cycle import HORIZON
from noack.scenario.parameter_changes import change_notice, scheduled
from noack.scenario.resolution import tables_of
from noack.scenario.scenario import Scenario, phases_ns
from tests.helpers.machine_parts import Machine, controller_of, plant_of, sensor_of
from tests.helpers.wire_decoder import Decoder
from tests.netem.stepped_channel import SteppedChannel

KEY = bytes(KEY_BYTES)
MACHINES: Mapping[str, Callable[[Scenario], Machine[Any]]] = {
    "plant": plant_of, "sensor": sensor_of, "controller": controller_of,
}  # fmt: skip
RANKS = {"plant": 0, "netem": 1, "controller": 4}
DATAGRAM_RANK = 2

Wrap = Callable[[Machine[Any]], Machine[Any]]


class ScriptedNetwork:
    """A network of one loop whose losses and delays a function decides."""

    def __init__(self, decide: UserNetwork) -> None:
        self._decide = decide
        self._inputs = self._packets = self._losses = 0
        self._newest = -1
        self._in_flight: list[tuple[int, int, Datagram]] = []

    def next_deadline_ns(self) -> int | None:
        return self._in_flight[0][0] if self._in_flight else None

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        release_ns, packet, datagram = heapq.heappop(self._in_flight)
        stale = packet < self._newest
        self._newest = max(self._newest, packet)
        row = (self._inputs, packet, release_ns, now_ns, datagram.flow, 0, int(stale))
        self._inputs += 1
        return (datagram, Record(NETEM_RELEASE, row))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        delay_ns = self._decide(message.data, now_ns)
        self._losses = self._losses + 1 if delay_ns is None else 0
        fate = Fate.DROPPED if delay_ns is None else Fate.DELIVERED
        release_ns = -1 if delay_ns is None else now_ns + delay_ns
        row = (
            self._inputs, self._packets, now_ns, now_ns, message.flow, fate, self._losses,
            release_ns, -1, -1, len(message.data), message.data[:32],
        )  # fmt: skip
        packet = self._packets
        self._inputs += 1
        self._packets += 1
        if delay_ns == 0:
            self._newest = max(self._newest, packet)
            return (message, Record(NETEM_PACKET, row))
        if delay_ns is not None:
            heapq.heappush(self._in_flight, (release_ns, packet, message))
        return (Record(NETEM_PACKET, row),)


class Loops:
    """The machines of a role of several loops, each on its own, as one machine."""

    def __init__(self, machines: Sequence[Machine[Any]], phases_ns: Sequence[int]) -> None:
        self._machines, self._phases_ns = machines, phases_ns

    def next_deadline_ns(self) -> int | None:
        return min(self._due(), default=(None, 0))[0]

    def handle(self, message: Any, now_ns: int) -> Sequence[Any]:
        machine = self._machines[message.loop]
        single = message._replace(loop=0)
        outputs = machine.handle(single, now_ns - self._phases_ns[message.loop])
        return [self._numbered(message.loop, output) for output in outputs]

    def on_timer(self, now_ns: int) -> Sequence[Any]:
        _, loop = min(self._due())
        outputs = self._machines[loop].on_timer(now_ns - self._phases_ns[loop])
        return [self._numbered(loop, output) for output in outputs]

    def announce(self, change: Any, now_ns: int) -> Sequence[Any]:
        outputs: list[Any] = []
        for loop, phase_ns in enumerate(self._phases_ns):
            change_of_loop = change._replace(t_ns=max(change.t_ns - phase_ns, 0))
            outputs_of_loop = self._machines[loop].announce(change_of_loop, now_ns - phase_ns)  # type: ignore[attr-defined]
            outputs += [self._numbered(loop, output) for output in outputs_of_loop]
        return outputs

    def _due(self) -> list[tuple[int, int]]:
        due = (machine.next_deadline_ns() for machine in self._machines)
        return [(t_ns + self._phases_ns[loop], loop) for loop, t_ns in enumerate(due) if t_ns is not None]

    def _numbered(self, loop: int, output: Any) -> Any:
        if isinstance(output, Record):
            return Record(output.table, (loop, *output.row))
        return output._replace(loop=loop)


class EventScheduler:
    """Carries datagrams between the machines of a run, in the order of virtual time."""

    def __init__(
        self,
        scenario: Scenario,
        loops: Sequence[Scenario],
        *,
        numbered: bool = False,
        network: UserNetwork | None = None,
        wraps: Mapping[str, Wrap] | None = None,
    ) -> None:
        phases = phases_ns(scenario)
        machines: dict[str, Machine[Any]] = {}
        machines["netem"] = SteppedChannel(channel_of(scenario, loops=len(loops)))
        for role, machine_of in MACHINES.items():
            single = [machine_of(loop) for loop in loops]
            machines[role] = Loops(single, phases) if numbered else single[0]
        if network is not None:
            machines["netem"] = ScriptedNetwork(network)
        for role, wrap in (wraps or {}).items():
            machines[role] = wrap(machines[role])
        self.scenario, self.loops, self.machines = scenario, loops, machines
        self._network = scenario.network.flows
        self._encoder = Encoder(RUN_ID, KEY)
        self.decoders = {role: self._decoders(RECEIVES[role]) for role in (*RANKS, "sensor")}
        self.acknowledgements = self._decoders(Flow.ACKNOWLEDGEMENT)
        self._sent: deque[tuple[str, str, bytes]] = deque()
        self._now_ns = 0
        self.rows: dict[str, list[tuple[Any, ...]]] = {}
        self.notices: list[dict[str, Any]] = []

    def run(self) -> None:
        """Drive the machines until nothing is due."""
        for _ in self.steps():
            pass

    def steps(self) -> Iterator[int]:
        """Announce the scenario's changes, and drive the machines; yield the time of each step."""
        changes = scheduled(self.scenario)
        for role in CHANGEABLE:
            for change in changes:
                self.emit(role, self.machines[role].announce(change, 0))  # type: ignore[attr-defined]
        self.emit(RECORDER, [change_notice(change) for change in changes])
        with np.errstate(all="ignore"):
            while due := self._next():
                self._now_ns, rank, role = due
                if rank == DATAGRAM_RANK:
                    self._receive(*self._sent.popleft())
                else:
                    self.emit(role, self.machines[role].on_timer(self._now_ns))
                yield self._now_ns

    def record(self) -> RunRecord:
        """Return the record of a run of one loop."""
        (scenario,) = self.loops
        rows = {
            table: np.array(self.rows.get(table, []), dtype) for table, dtype in tables_of(scenario).items()
        }
        reports: dict[str, Any] = {}
        for role in LOOP_ROLES:
            owned = {table: len(batch) for table, batch in rows.items() if OWNER[table] == role}
            channel = {"rejected": {}} if role == "netem" else self.decoders[role][0].report()
            reports[role] = {"ended": HORIZON, "channel": channel, "rows": owned}
        if scenario.protocol.acknowledges:
            counts = self.acknowledgements[0].report()
            reports["sensor"]["channel"]["acknowledgements"] = counts
        notices = sorted(self.notices, key=lambda notice: int(notice["t_ns"]))
        return RunRecord(scenario, rows, notices, reports, "simulated")

    def _next(self) -> tuple[int, int, str] | None:
        due = [
            (t_ns, rank, role)
            for role, rank in RANKS.items()
            if (t_ns := self.machines[role].next_deadline_ns()) is not None
        ]
        if self._sent:
            due.append((self._now_ns, DATAGRAM_RANK, ""))
        return min(due, default=None)

    def _receive(self, sender: str, role: str, data: bytes) -> None:
        message: Any
        if role == "netem":
            direction = [ENDS[flow].sender for flow in self._network].index(sender)
            message = Datagram(direction * len(self.loops) + (loop_number(data) or 0), data)
        else:
            acknowledged = (sender, role) == ("netem", "sensor")
            decoders = self.acknowledgements if acknowledged else self.decoders[role]
            loop = loop_number(data) or 0
            message = decoders[loop if loop < len(decoders) else 0].decode(data)
        if message is not None:
            self.emit(role, self.machines[role].handle(message, self._now_ns))

    def emit(self, role: str, outputs: Sequence[Any]) -> None:
        """Keep the rows and notices of a machine, and send its messages."""
        for output in outputs:
            if isinstance(output, Record):
                self.rows.setdefault(output.table, []).append(output.row)
            elif isinstance(output, Notice):
                line = output._replace(loop=None).line()
                self.notices.append(line | {"process": role})
            else:
                forwarded = isinstance(output, Datagram)
                data = output.data if forwarded else self._encoder.encode(output)
                flow = self._network[output.flow // len(self.loops)] if forwarded else output.flow
                self._sent.append((role, receiver_of(role, flow, self._network), data))

    def _decoders(self, flow: Flow) -> list[Decoder]:
        return [
            Decoder(flow, 0 if flow is Flow.ACKNOWLEDGEMENT else loop.message_sizes.entries(flow),
                    RUN_ID, KEY, loop=number)
            for number, loop in enumerate(self.loops)
        ]  # fmt: skip


def record_of_run(
    resolved: Scenario, network: UserNetwork | None = None, wraps: Mapping[str, Wrap] | None = None
) -> RunRecord:
    """Return the record of a run of one loop."""
    scheduler = EventScheduler(resolved, (resolved,), network=network, wraps=wraps)
    scheduler.run()
    return scheduler.record()

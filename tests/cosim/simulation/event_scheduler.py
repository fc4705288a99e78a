"""The order of a simulation in plain Python: machines step by step, and encoded datagrams.

native/driver/virtual.c does the same with structures. Tests compare both; some replace a machine.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from cosim.record.run_record import RunRecord
from noack.machines.run_channel import RUN_ID, Datagram, UserNetwork, channel_of
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import CHANGEABLE, ENDS, LOOP_ROLES, RECEIVES, RECORDER, Notice, Record, receiver_of
from noack.protocol.wire_format import KEY_BYTES, Encoder, Flow
from noack.runtime.end_reasons import HORIZON
from noack.scenario.parameter_changes import change_notice, scheduled
from noack.scenario.resolution import tables_of
from noack.scenario.scenario import Scenario
from tests.helpers.machine_parts import Machine, controller_of, plant_of, sensor_of
from tests.helpers.wire_decoder import Decoder
from tests.noack.machines.stepped_channel import SteppedChannel

KEY = bytes(KEY_BYTES)
MACHINES: Mapping[str, Callable[[Scenario], Machine[Any]]] = {
    "plant": plant_of, "sensor": sensor_of, "controller": controller_of,
}  # fmt: skip
RANKS = {"plant": 0, "netem": 1, "controller": 4}
DATAGRAM_RANK = 2

Wrap = Callable[[Machine[Any]], Machine[Any]]


class EventScheduler:
    """Carries datagrams between the machines of a run of one loop, in the order of virtual time."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        network: UserNetwork | None = None,
        wraps: Mapping[str, Wrap] | None = None,
    ) -> None:
        machines: dict[str, Machine[Any]] = {
            "netem": SteppedChannel(channel_of(scenario, network=network)),
            **{role: machine_of(scenario) for role, machine_of in MACHINES.items()},
        }
        for role, wrap in (wraps or {}).items():
            machines[role] = wrap(machines[role])
        self.scenario, self.machines = scenario, machines
        self._network = scenario.network.flows
        self._encoder = Encoder(RUN_ID, KEY)
        self._decoders = {role: self._decoder(RECEIVES[role]) for role in (*RANKS, "sensor")}
        self._acknowledgements = self._decoder(Flow.ACKNOWLEDGEMENT)
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
        """Return the record of the run."""
        scenario = self.scenario
        rows = {
            table: np.array(self.rows.get(table, []), dtype) for table, dtype in tables_of(scenario).items()
        }
        reports: dict[str, Any] = {}
        for role in LOOP_ROLES:
            owned = {table: len(batch) for table, batch in rows.items() if OWNER[table] == role}
            channel = {"rejected": {}} if role == "netem" else self._decoders[role].report()
            reports[role] = {"ended": HORIZON, "channel": channel, "rows": owned}
        if scenario.protocol.acknowledges:
            counts = self._acknowledgements.report()
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
            message = Datagram([ENDS[flow].sender for flow in self._network].index(sender), data)
        else:
            acknowledged = (sender, role) == ("netem", "sensor")
            message = (self._acknowledgements if acknowledged else self._decoders[role]).decode(data)
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
                flow = self._network[output.flow] if forwarded else output.flow
                self._sent.append((role, receiver_of(role, flow, self._network), data))

    def _decoder(self, flow: Flow) -> Decoder:
        entries = 0 if flow is Flow.ACKNOWLEDGEMENT else self.scenario.message_sizes.entries(flow)
        return Decoder(flow, entries, RUN_ID, KEY, loop=0)


def record_of_run(
    resolved: Scenario, network: UserNetwork | None = None, wraps: Mapping[str, Wrap] | None = None
) -> RunRecord:
    """Return the record of a run of one loop."""
    scheduler = EventScheduler(resolved, network=network, wraps=wraps)
    scheduler.run()
    return scheduler.record()

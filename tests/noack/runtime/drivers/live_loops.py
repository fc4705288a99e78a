"""A process of a run with its live driver, and the other ends of its flows as sockets of a test."""

import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from controller_node.controller import controllers_of
from netem.core.clock import RunClock
from noack.machines.loop_machines import LoopMachines
from noack.protocol.roles import SENDS, Notice, Record
from noack.protocol.wire_format import Encoder, Flow, Message, Wire
from noack.runtime.counting_sockets import bind
from noack.runtime.drivers.live_driver import LiveDriver, LoopSockets
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from plant_server.plant import plants_of
from sensor_node.sensor import sensors_of
from tests.helpers.machine_parts import SteppedMachines

RUN_ID, KEY = 7, bytes(range(32))
HOUR_NS = 3600 * 10**9
MAKERS: dict[str, Callable[..., LoopMachines]] = {
    "plant": plants_of, "sensor": sensors_of, "controller": controllers_of,
}  # fmt: skip


def plain(row: Sequence[Any]) -> tuple[Any, ...]:
    """Return a row with lists instead of arrays."""
    return tuple(entry.tolist() if isinstance(entry, np.ndarray) else entry for entry in row)


class Rows:
    """Keeps the rows and lines of a record."""

    def __init__(self) -> None:
        self.tables: dict[str, list[Any]] = {}
        self.notices: list[Notice] = []
        self._columns: dict[str, Sequence[str]] = {}

    def append(self, record: Record) -> None:
        self.tables.setdefault(record.table, []).append(record.row)

    def extend_table(self, table: str, rows: Any) -> None:
        self._columns[table] = rows.dtype.names
        self.tables.setdefault(table, []).extend(plain(row.item()) for row in rows)

    def notice(self, notice: Notice) -> None:
        self.notices.append(notice)

    def flush(self) -> None: ...

    def of(self, table: str, column: str) -> list[Any]:
        """Return a column of rows that came as arrays."""
        place = self._columns[table].index(column)
        return [row[place] for row in self.tables.get(table, ())]


def scenario(content: dict[str, Any], **changes: Any) -> Scenario:
    """Return the resolved scenario of 5 s with other sections."""
    return resolve(validate(content | {"horizon_s": 5.0} | changes, "here"))


class Live:
    """The machines of a role with their driver and sockets; ``peer`` sends what they receive.

    Args:
        role: the process.
        loops: the resolved scenario of each loop.
        phases_ns: when they begin.
        early: called before the sockets exist.
        since_ns: how long ago the run began, in wall time.
    """

    def __init__(
        self,
        role: str,
        loops: Sequence[Scenario],
        phases_ns: Sequence[int] | None = None,
        *,
        encrypted: bool = False,
        acknowledged: bool = False,
        since_ns: int = 0,
        early: Callable[["Live"], None] = lambda live: None,
        **settings: int,
    ) -> None:
        self._stack = ExitStack()
        self.endpoint, self.peer, self.other, self.answers = (
            self._stack.enter_context(bind(0, "test")) for _ in range(4)
        )
        self.machines = self.new_machines(role, loops, phases_ns)
        self.alone = SteppedMachines(self.new_machines(role, loops, phases_ns).parts, phases_ns)
        """The same machines, to which a test passes the inputs one by one."""
        wire = Wire(RUN_ID, KEY, encrypted=encrypted)
        self.encoder = Encoder(RUN_ID, KEY, encrypted=encrypted)
        self.driver = LiveDriver(self.machines, wire, **settings)
        self.rows = Rows()
        self.address = self.endpoint.getsockname()
        early(self)
        own = self.peer.getsockname()
        self.sockets = LoopSockets(
            self.endpoint, self.driver, SENDS[role], source=own, destination=own,
            acknowledged_by=self.answers.getsockname() if acknowledged else None,
            acknowledges_to=self.answers.getsockname() if role == "controller" else None,
        )  # fmt: skip
        self.clock = RunClock(time.monotonic_ns() - since_ns)
        self.driver.set_clock(self.clock)

    def new_machines(
        self, role: str, loops: Sequence[Scenario], phases_ns: Sequence[int] | None
    ) -> LoopMachines:
        return MAKERS[role](loops, phases_ns)

    def send(self, *messages: Message, by: socket.socket | None = None) -> None:
        """Send messages, by default from the peer."""
        for message in messages:
            (by or self.peer).sendto(self.encoder.encode(message), self.address)

    def drive(self, until: Callable[[], bool]) -> None:
        """Drive for a millisecond at a time."""
        self.driver.drive(self.clock.now_ns(), self.rows)
        while not until():
            self.driver.drive(self.clock.now_ns() + 1_000_000, self.rows)

    def drive_until_accepted(self, count: int) -> None:
        self.drive(lambda: self.driver.accepted >= count)

    def close(self) -> None:
        self.sockets.close()
        self._stack.close()


def received(endpoint: socket.socket, most_bytes: int = 2048) -> list[bytes]:
    """Return the datagrams that wait at a socket; loopback delivers at once."""
    datagrams = []
    while True:
        try:
            datagrams.append(endpoint.recv(most_bytes))
        except BlockingIOError:
            return datagrams


def measurement(number: int, x: Sequence[float], loop: int = 0) -> Message:
    return Message(Flow.MEASUREMENT, number, number * 1_000_000, np.array(x), loop)

"""The machines of one role of many loops as one machine of compiled code, which drives itself.

It does what a :class:`noack.protocol.fleet.Fleet` of the single machines does, with the same bits.
"""

import socket
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from noack.config.fleet_layout import HEADER_WORDS, STRIDE, FleetParts, FleetRole
from noack.config.loops import phases_ns
from noack.config.parameter_changes import (
    ChangeSchedule,
    ParameterChange,
    announcement_outputs,
)
from noack.config.resolution import loop_of, run_tables, tables_of
from noack.config.runtime_parameters import is_of_network_alone, text_of
from noack.config.scenario import Scenario
from noack.core.clock import RunClock
from noack.core.errors import CallerError
from noack.protocol.fleet import of_loop
from noack.protocol.machine_interface import Notice, Output, Record
from noack.protocol.topology import RECEIVES, SENDS
from noack.protocol.wire_format import Encoder, Message
from noack.runtime.address import Address
from noack.runtime.fleet import driver_layout as layout
from noack.runtime.fleet.driver_layout import DriverMemory
from noack.runtime.fleet.fleet_memory import driver_memory, wire_memory
from noack.runtime.fleet.wire_words import REASONS
from noack.runtime.native.socket_structs import packed_name
from noack.runtime.real_time_loop import RecordSink

_PAST_NS = -(2**62)
_REST_SHARE = 20
_LONGEST_REST_NS = 1_000_000

Driver = Callable[..., int]


class CompiledFleet:
    """A machine that also drives itself between two turns of housekeeping.

    Args:
        name: the role in the topology.
        role: its compiled functions.
        parts: the machines of all loops.
        run: the resolved scenario of the run.
        loops: the resolved scenario of each loop.
        run_id: the number of the run, for the datagrams.
        key: its key.
    """

    def __init__(
        self,
        name: str,
        role: FleetRole,
        parts: FleetParts,
        run: Scenario,
        loops: Sequence[Scenario],
        run_id: int,
        key: bytes,
    ) -> None:
        self._parts, self._own, tables = (
            parts,
            parts.arrays,
            (run_tables(run) if run.loops else tables_of(run)),
        )
        self._sends = SENDS[name]
        self._on_message, timer = role.on_message, role.on_timer
        self._on_timer = role.on_message if timer is None else timer
        self._types = tables[self._on_timer], tables[self._on_message]
        self._encoder = Encoder(run_id, key)
        self._phases_ns, self._schedule = phases_ns(run), ChangeSchedule(loops[0])
        one = loop_of(loops[0])
        self._sent = loops[0].message_sizes.entries(self._sends)
        wire = wire_memory(self._sends, RECEIVES[name], loops[0].message_sizes, run_id, key)
        self._memory = driver_memory(parts, self._phases_ns, (one.n, one.m), self._types, wire)
        rest_ns = int(loops[0].timing.plant_period_ns / _REST_SHARE / run.speed)
        self._memory.driver["rest_ns"] = min(rest_ns, _LONGEST_REST_NS)
        self._notices: list[Notice] = []
        self._run: Driver | None = None

    def use(self, driver: Driver) -> None:
        """Use this driver."""
        self._run = driver

    @property
    def arguments(self) -> tuple[DriverMemory, Any]:
        """The arguments of the driver besides the time."""
        return self._memory, self._own

    def open(
        self, clock: RunClock, sender: socket.socket, receiver: socket.socket, destination: Address
    ) -> None:
        """Use these sockets from now on; ``sender`` is not connected."""
        driver = self._memory.driver
        driver["epoch_ns"], driver["speed"] = clock.epoch_ns, clock.speed
        driver["fd_in"], driver["fd_out"] = receiver.fileno(), sender.fileno()
        driver["from_peer"] = 1
        packed, name_bytes = packed_name(destination)
        self._name = np.frombuffer(packed, np.uint8).copy()
        self._memory.headers_out["name"] = self._name.ctypes.data
        self._memory.headers_out["name_bytes"] = name_bytes

    def next_deadline_ns(self) -> int | None:
        """The earliest deadline of all loops, in the time of the run."""
        return int(self._memory.heap[0]) if self._memory.driver[0]["due"] else None

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Record a change of the network for each loop, and check losses by it.

        Raise CallerError for other settings: the arrays keep theirs.
        """
        if not is_of_network_alone(change.settings):
            raise CallerError(f"compiled machines keep their settings: {text_of(change.settings)}")
        self._schedule.announce("", change, 0, 0, -1)
        if self._parts.follow is not None:
            self._parts.follow(self._schedule, self._phases_ns)
        outputs: list[Record | Notice] = []
        loops = self._memory.fleet.loops
        # Of the inputs so far, change.number were announcements.
        reached_ns = np.where(loops["inputs"] > change.number, self._own[0]["model_ns"], -1)
        for loop, (phase_ns, reached) in enumerate(
            zip(self._phases_ns, reached_ns.tolist(), strict=True)
        ):
            own = change._replace(t_ns=max(change.t_ns - phase_ns, 0))
            since_ns, number = max(own.t_ns, reached + 1), int(loops["inputs"][loop])
            outputs += [
                of_loop(loop, output)
                for output in announcement_outputs(
                    self._parts.changes, own, number, now_ns - phase_ns, since_ns
                )
            ]
        loops["inputs"] += 1
        return outputs

    def drive(self, until_ns: int, sink: RecordSink) -> None:
        """Work until a time, and pass on the rows of the record."""
        while self._turn(until_ns) != layout.HOUSEKEEPING:
            self._pass_rows(sink)
        self._pass_rows(sink)

    def take(self, datagram: bytes, *, from_peer: bool) -> Sequence[Record | Notice]:
        """Process a datagram that Python has received; return the rows."""
        self._put(datagram, from_peer=from_peer)
        outputs = _Outputs()
        self.drive(_PAST_NS, outputs)
        self._memory.driver["from_peer"] = 1
        return outputs.rows

    def encode(self, message: Message) -> bytes:
        """Return the datagram of a message."""
        return self._encoder.encode(message)

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process a message; return the outputs, without sockets."""
        self._put(self._encoder.encode(message), from_peer=True)
        return self.on_timer(now_ns)

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Do what is due; return the outputs, without sockets."""
        self._memory.driver["epoch_ns"] = now_ns
        outputs = _Outputs()
        self.drive(_PAST_NS, outputs)
        fleet, messages = self._memory.fleet, list[Message]()
        for begin in range(0, int(fleet.fleet[0]["out"]) * STRIDE, STRIDE):
            first, _, sequence, t_ns = fleet.out[begin : begin + HEADER_WORDS].tolist()
            vector = fleet.out_reals[begin + HEADER_WORDS :][: self._sent].copy()
            loop = first >> 48 & 0xFFFF
            messages.append(Message(self._sends, sequence, t_ns, vector, loop))
        fleet.fleet["out"] = 0
        return [*messages, *outputs.rows]

    @property
    def timer_table(self) -> str:
        """The table of the rows of timers; that of messages, if there are no timers."""
        return self._on_timer

    @property
    def message_table(self) -> str:
        """The table of the rows of messages."""
        return self._on_message

    @property
    def tables(self) -> tuple[str, ...]:
        """The tables of the role."""
        return tuple(dict.fromkeys((self._on_timer, self._on_message)))

    @property
    def sent_words(self) -> int:
        """Words of number, time and vector of a message that the machines send."""
        return 2 + self._sent

    def replay(self, code: Driver, tables: tuple[Any, ...], inputs: int) -> int:
        """Replay recorded inputs (:mod:`noack.runtime.fleet.replay_driver`); return the reason."""
        while True:
            reason = code(self._memory, self._own, *tables, inputs)
            if reason != layout.MATRIX_MISSING:
                return reason
            self._add_matrix()

    def reports(self) -> list[dict[str, object]]:
        """Counters of each loop, for the run's summary."""
        reports: list[dict[str, object]] = []
        accepted = self._memory.fleet.loops["accepted"].tolist()
        for count, rejected in zip(accepted, self._memory.rejected.tolist(), strict=True):
            by_reason = {one.value: n for one, n in zip(REASONS, rejected, strict=True) if n}
            reports.append({"accepted": count, "rejected": by_reason})
        return reports

    @property
    def accepted(self) -> int:
        """Number of accepted datagrams."""
        return int(self._memory.fleet.loops["accepted"].sum())

    @property
    def rejected(self) -> dict[str, int]:
        """Number of rejected datagrams, by reason."""
        counts = self._memory.rejected.sum(axis=0).tolist()
        return {reason.value: n for reason, n in zip(REASONS, counts, strict=True)}

    @property
    def sent(self) -> int:
        """Number of datagrams sent."""
        return int(self._memory.driver[0]["sent"])

    @property
    def send_errors(self) -> dict[int, int]:
        """Number of datagrams that could not be sent, by errno."""
        errors = self._memory.errors
        return {int(error): int(errors[error]) for error in np.flatnonzero(errors)}

    def _put(self, datagram: bytes, *, from_peer: bool) -> None:
        driver, fleet = self._memory.driver, self._memory.fleet
        given = np.frombuffer(datagram[: 8 * STRIDE], np.uint8)
        fleet.arrived.view(np.uint8)[: len(given)] = given
        self._memory.headers_in["size_bytes"][0] = len(given)
        driver["arrived_next"], driver["arrived_end"], driver["from_peer"] = 0, 1, from_peer

    def _turn(self, until_ns: int) -> int:
        """Run the driver until it returns, and do what it needs; return the reason."""
        assert self._run is not None
        reason = self._run(self._memory, self._own, until_ns)
        if reason == layout.MATRIX_MISSING:
            self._add_matrix()
        return reason

    def _add_matrix(self) -> None:
        """Compute the transition matrix that was missing."""
        transitions = self._parts.transitions
        assert transitions is not None
        transitions.add_wanted()
        if transitions.table is not self._own.models:
            self._own = self._own._replace(models=transitions.table)

    def _take_notes(self) -> None:
        """Word the lines for the log that the machines asked for."""
        fleet, word = self._memory.fleet, self._parts.notice
        if word is not None:
            for note in fleet.notes[: fleet.fleet[0]["notes"]]:
                self._notices.append(word(self._own, note)._replace(loop=int(note["loop"])))
            fleet.fleet["notes"] = 0

    def _pass_rows(self, sink: RecordSink) -> None:
        """Hand over the rows and log lines."""
        driver, (timer, message) = self._memory.driver[0], self._types
        ticks = self._memory.timer_rows.view(timer)[: driver["timer_rows"]]
        deliveries = self._memory.message_rows.view(message)[: driver["message_rows"]]
        if len(ticks):
            sink.extend_table(self._on_timer, ticks)
        if len(deliveries):
            if self._parts.inspect is not None:
                found = self._parts.inspect(deliveries)
                self._notices += [notice._replace(loop=loop) for loop, notice in found]
            sink.extend_table(self._on_message, deliveries)
        driver["timer_rows"] = driver["message_rows"] = 0
        self._take_notes()
        for notice in self._notices:
            sink.notice(notice)
        self._notices.clear()


class _Outputs:
    """A sink that keeps what it gets."""

    def __init__(self) -> None:
        self.rows: list[Record | Notice] = []

    def append(self, record: Record) -> None:
        self.rows.append(record)

    def extend_table(self, table: str, rows: Any) -> None:
        """Keep rows, with arrays of their own."""
        for row in rows.copy():
            self.rows.append(Record(table, tuple(row[name] for name in rows.dtype.names)))

    def notice(self, notice: Notice) -> None:
        self.rows.append(notice)

    def flush(self) -> None:
        """Nothing is published."""

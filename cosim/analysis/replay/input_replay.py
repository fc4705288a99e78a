"""Replays a machine, or the network, from its recorded rows: native/driver/replay.c does the work.

The core feeds the recorded inputs and compares each row that the machine writes. This explains the
first difference, and answers what the core asks: for users' code, and for changes of settings.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.replay.replay_result import difference, rows_differ
from cosim.analysis.summary_model import ReplayDifference
from cosim.record.record_source import Rows, Slice
from netem.channel import NO_TIME_NS, Channel
from noack.config.parameter_changes import ParameterChange, settings_of
from noack.core.core_library import core, ffi, pointer_to
from noack.core.errors import CallerError
from noack.machines.loop_machines import LoopMachines
from noack.protocol.machine_interface import Record
from noack.protocol.record_tables import (
    CONTROLLER_STEP,
    LOOP,
    NETEM_RELEASE,
    OWNER,
    PACKET_HEAD_BYTES,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SETTINGS,
    entry_names,
)
from noack.protocol.topology import RECEIVES
from noack.protocol.wire_format import Flow

Numbers = NDArray[np.int64]

_ROLES = {"plant": 0, "sensor": 1, "controller": 2, "netem": 3}
_TIMERS = (PLANT_STEP, CONTROLLER_STEP, NETEM_RELEASE)
_DAMAGE = (ArithmeticError, LookupError, ValueError, CallerError)
"""Errors of a machine that gets an input from a damaged record, which no run can have."""
_HEADER_WORDS = 3
_DATAGRAM_WORDS = 1 + PACKET_HEAD_BYTES // 8


class SentMessages(NamedTuple):
    """Messages of a flow."""

    sequences: Numbers
    t_ns: Numbers
    vectors: NDArray[np.float64]
    """(k, entries)"""

    def at(self, places: slice | Numbers) -> "SentMessages":
        """Return those at some places."""
        return SentMessages(self.sequences[places], self.t_ns[places], self.vectors[places])

    def followed_by(self, more: "SentMessages") -> "SentMessages":
        """Return these and more."""
        if not len(self.sequences):
            return more
        return SentMessages(
            np.concatenate([self.sequences, more.sequences]),
            np.concatenate([self.t_ns, more.t_ns]),
            np.concatenate([self.vectors, more.vectors]),
        )


NONE_SENT = SentMessages(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 0)))


class InputReplay:
    """A machine, or the network, under replay.

    Args:
        role: whose it is.
        machine: new machines of one loop, or a new network.
        sizes: entries of the vectors that the machine sends, by flow.
    """

    def __init__(
        self, role: str, machine: LoopMachines | Channel, sizes: Mapping[Flow, int]
    ) -> None:
        self.difference: ReplayDifference | None = None
        self._machine, self._sizes = machine, sizes
        self._is_network = isinstance(machine, Channel)
        width = _DATAGRAM_WORDS if self._is_network else _HEADER_WORDS + max(sizes.values())
        self._core: Any = ffi.new("noack_input_replay *", {
            "role": _ROLES[role], "before_ns": -(2**63), "sent_width": width,
            ("channel" if self._is_network else "process"): machine.core,
        })  # fmt: skip
        self._sent = np.zeros((0, width), np.int64)

    def replay(self, owned: Slice, order: Numbers, before: Mapping[str, int]) -> int:
        """Feed the next inputs, and compare the rows.

        Args:
            owned: the next rows by table.
            order: places of the inputs among the rows of all tables, in order.
            before: numbers of rows before them, by table.

        Returns:
            How many inputs the machine took; it stops at one that it cannot take.
        """
        replay = self._core
        tables = {table: np.ascontiguousarray(rows) for table, rows in owned.items()}
        for place, table in enumerate(tables):
            replay.tables[place] = _recorded_table(table, tables[table])
        for place in range(len(tables), 4):
            replay.tables[place].count = 0
        order = np.ascontiguousarray(order, np.int64)
        self._sent = np.zeros(((1 + self._is_network) * len(order), replay.sent_width), np.int64)
        replay.order, replay.count = pointer_to(order, "int64_t *"), len(order)
        replay.sent, replay.sent_count = pointer_to(self._sent, "int64_t *"), 0
        replay.next = 0
        if (wrong := core.noack_replay_check(replay)) != ffi.NULL:
            raise ValueError(f"replay: {ffi.string(wrong).decode()}")
        place_of = _Places(tables, order, before)
        try:
            while (reason := core.noack_replay_inputs(replay)) != core.NOACK_DONE:
                if reason == core.NOACK_CANNOT_TAKE:
                    raise ValueError("no run has these numbers")
                if reason == core.NOACK_REPLAY_SETTING:
                    self._announce(place_of)
                else:
                    self._machine.answer(reason)
        except _DAMAGE as error:
            self._explain(place_of)
            self._note(place_of, replay.next, f"the machine cannot take this input: {error}")
        self._explain(place_of)
        replay.difference = core.NOACK_EQUAL
        if self._is_network:
            self._machine.take_rows()
        return int(replay.next)

    def sent_in(self, flow: Flow) -> SentMessages:
        """Return the messages of a flow that the machine sent in the newest part."""
        sent = self._sent[: self._core.sent_count]
        entries = self._sizes.get(flow, 0)
        words = sent[sent[:, 0] == flow][:, : _HEADER_WORDS + entries]
        vectors = np.ascontiguousarray(words[:, _HEADER_WORDS:]).view(np.float64)
        return SentMessages(words[:, 1].copy(), words[:, 2].copy(), vectors)

    def forwarded(self) -> tuple[Numbers, NDArray[np.void]]:
        """Return flows and heads of the datagrams that left the network in the newest part."""
        sent = self._sent[: self._core.sent_count]
        heads = np.ascontiguousarray(sent[:, 1:]).view(f"V{PACKET_HEAD_BYTES}")
        return sent[:, 0], heads[:, 0]

    def _announce(self, place_of: "_Places") -> None:
        """Let the machine receive a change of settings; compare its row."""
        replay = self._core
        table, row, rows = place_of(replay.next)
        recorded = rows[row]
        change = ParameterChange(
            int(recorded["sequence"]), int(recorded["t_ns"]),
            _settings(recorded["change"].tobytes()),
        )  # fmt: skip
        outputs = self._machine.announce(change, int(recorded["now_ns"]))
        (emitted,) = (output for output in outputs if type(output) is Record)
        values = emitted.row if self._is_network else emitted.row[1:]  # without the loop's number
        replayed = np.zeros(1, rows.dtype)[0]
        for name, value in zip(_own_names(rows.dtype), values, strict=True):
            replayed[name] = value
        if LOOP in (rows.dtype.names or ()):
            replayed[LOOP] = recorded[LOOP]
        if replay.difference == core.NOACK_EQUAL and replayed.tobytes() != recorded.tobytes():
            self._explain(place_of)
            found = rows_differ(table, place_of.number(table, row), recorded, replayed)
            self.difference = self.difference or found
        replay.before_ns = int(recorded["now_ns"])
        replay.next += 1

    def _explain(self, place_of: "_Places") -> None:
        """Keep the first difference that the core has found."""
        replay = self._core
        if self.difference is not None or replay.difference == core.NOACK_EQUAL:
            return
        at, other = replay.difference_at, replay.other_ns
        other_ns = None if other == NO_TIME_NS else other
        table, row, rows = place_of(at)
        now_ns = int(rows["now_ns"][row])
        if replay.difference == core.NOACK_TIME_RUNS_BACKWARD:
            self._note(place_of, at, "time runs backward", "now_ns", now_ns, other_ns)
        elif replay.difference == core.NOACK_BEFORE_DEADLINE:
            self._note(place_of, at, "acted before its deadline", "now_ns", now_ns, other_ns)
        elif replay.difference == core.NOACK_OTHER_TABLE:
            self._note(place_of, at, "the machine does not answer with one row of this table")
        else:
            replayed = rows[row : row + 1].copy()
            own = replayed.view(np.uint8).reshape(-1)
            skipped = _prefix_bytes(rows.dtype)
            own[skipped:] = np.frombuffer(ffi.buffer(replay.replayed), np.uint8)[
                : len(own) - skipped
            ]
            number = place_of.number(table, row)
            self.difference = rows_differ(table, number, rows[row], replayed[0])

    def _note(self, place_of: "_Places", at: int, what: str, *values: Any) -> None:
        """Keep a difference at an input, if it is the first one."""
        table, row, rows = place_of(at)
        number, now_ns = place_of.number(table, row), int(rows["now_ns"][row])
        if self.difference is None:
            self.difference = difference(table, number, now_ns, what, *values)


class _Places:
    """Where the inputs are in the tables."""

    def __init__(self, tables: Slice, order: Numbers, before: Mapping[str, int]) -> None:
        self._tables, self._order, self._before = tables, order, before

    def __call__(self, at: int) -> tuple[str, int, Rows]:
        """Return the table of an input, its row there, and the rows."""
        table, row = table_and_row(self._tables, int(self._order[at]))
        return table, row, self._tables[table]

    def number(self, table: str, row: int) -> int:
        """Return the number of a row in the whole table."""
        return self._before[table] + row


def table_and_row(owned: Slice, place: int) -> tuple[str, int]:
    """Return table and row of a place among the rows of all tables."""
    for table, rows in owned.items():
        if place < len(rows):
            return table, place
        place -= len(rows)
    raise IndexError("the tables have fewer rows")


def received_columns(table: str, dtype: np.dtype[np.void]) -> list[str]:
    """Return the columns with the vector of a received message, in its order."""
    names = dtype.names or ()
    if table == SENSOR_ACKNOWLEDGEMENT:
        return []
    if RECEIVES[OWNER[table]] is Flow.ACTUATION:
        return [column for column in ("u", "predicted", "x_c") if column in names]
    return ["y", "u_applied"] if "y" in names else ["x"]


def received_vectors(table: str, rows: Rows) -> tuple[NDArray[np.float64], list[str]]:
    """Return the vectors of the received messages, (k, n), and the names of their entries."""
    columns = received_columns(table, rows.dtype)
    vectors = np.hstack([np.zeros((len(rows), 0)), *(rows[column] for column in columns)])
    return vectors, [
        entry for column in columns for entry in entry_names(column, rows[column].shape[1])
    ]


def _recorded_table(table: str, rows: Rows) -> dict[str, Any]:
    """Return a ``noack_recorded_table``; it is valid while the rows live."""
    skipped, stride = _prefix_bytes(rows.dtype), rows.dtype.itemsize
    fields: Mapping[str, Any] = rows.dtype.fields or {}
    vector: list[tuple[int, int]] = []
    if table in SETTINGS:
        kind = core.NOACK_SETTINGS
    elif table in _TIMERS:
        kind = core.NOACK_TICKS
    elif table == SENSOR_ACKNOWLEDGEMENT:
        kind = core.NOACK_ACKNOWLEDGEMENTS
    else:
        kind = core.NOACK_MESSAGES
        if OWNER[table] != "netem":
            columns = (fields[column] for column in received_columns(table, rows.dtype))
            vector = [(offset - skipped, of.shape[0]) for of, offset, *_ in columns]
    return {
        "kind": kind, "row_bytes": stride - skipped, "stride": stride, "count": len(rows),
        "rows": pointer_to(rows, "uint8_t *") + skipped, "vector": vector,
    }  # fmt: skip


def _own_names(dtype: np.dtype[np.void]) -> Sequence[str]:
    return [name for name in dtype.names or () if name != LOOP]


def _prefix_bytes(dtype: np.dtype[np.void]) -> int:
    return 2 * (LOOP in (dtype.names or ()))


def _settings(data: bytes) -> dict[str, Any]:
    """Return the changes of settings without the invalid ones of a damaged record."""
    try:
        return settings_of(data)
    except ValueError:
        return {"": None}

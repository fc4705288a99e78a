"""Replays machines, and the network, from their recorded rows.

:class:`MachineReplay` follows the machine of a role up to the first gap in its rows.
:class:`InputReplay` is the machine; native/driver/replay.c does the work: it feeds the
recorded inputs and compares each row that the machine writes. The class explains the first
difference, and answers what the core asks: for users' code, and for changes of settings.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from controller_node.controller import controllers_of
from cosim.analysis.replay.replay_result import ProcessReplay, difference, first_row_difference
from cosim.analysis.summary.summary_model import ReplayDifference
from cosim.record.rows import Rows, Slice
from cosim.record.run_record import RunRecord
from netem.core.clock import NEVER_NS
from netem.core.core_library import CData
from netem.core.errors import CallerError
from netem.core.packet_rows import NETEM_RELEASE, PACKET_HEAD_BYTES
from noack.core.cached_method import cached_method
from noack.core.core_library import core, ffi, pointer_to
from noack.machines.loop_machines import LoopMachines, MachinePart
from noack.machines.run_channel import RunChannel, channel_of
from noack.protocol.record_tables import (
    CONTROLLER_STEP,
    LOOP,
    OWNER,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SETTINGS,
    entry_names,
)
from noack.protocol.roles import RECEIVES, SENDS, Record
from noack.protocol.wire_format import Flow
from noack.scenario.parameter_changes import ParameterChange, settings_of
from noack.scenario.scenario import Scenario, loop_names
from plant_server.plant import plants_of
from sensor_node.sensor import sensors_of

Numbers = NDArray[np.int64]
_ROLES = {"plant": 0, "sensor": 1, "controller": 2, "netem": 3}
_TIMERS = (PLANT_STEP, CONTROLLER_STEP, NETEM_RELEASE)
_ANSWERS = {PLANT_STEP: "x", CONTROLLER_STEP: "u"}
"""The column with the answer of a plant or controller outside of noack."""
_DAMAGE = (ArithmeticError, LookupError, ValueError, CallerError)
"""Errors of a machine that gets an input from a damaged record, which no run can have."""
_HEADER_WORDS = 3
SEQUENCE, TIME, VECTOR = 0, 1, 2
"""Columns of the words of a message; those of its vector have the bits of its entries. A message that
was sent has its error level after them."""
_DATAGRAM_WORDS = 1 + PACKET_HEAD_BYTES // 8


class InputReplay:
    """A machine, or the network, under replay.

    Args:
        role: whose it is.
        machine: new machines, or a new network.
        sizes: entries of the vectors that the machine sends, by flow.
        loop: the index of its loop among those of the machines.
    """

    def __init__(
        self, role: str, machine: LoopMachines | RunChannel, sizes: Mapping[Flow, int], loop: int = 0
    ) -> None:
        self.difference: ReplayDifference | None = None
        self._machine, self._sizes = machine, sizes
        self._is_network = isinstance(machine, RunChannel)
        width = _DATAGRAM_WORDS if self._is_network else _HEADER_WORDS + max(sizes.values()) + 1
        self._core: CData = ffi.new(
            "noack_input_replay *",
            {
                "role": _ROLES[role],
                "before_ns": -(2**63),
                "sent_width": width,
                "loop": loop,
                ("channel" if self._is_network else "process"): machine.core,
            },
        )
        self._sent = np.zeros((0, width), np.int64)

    def replay(self, owned: Slice, order: Numbers, before: Mapping[str, int]) -> int:
        """Feed the next inputs, and compare the rows.

        Args:
            owned: the next rows by table.
            order: indices of the inputs among the rows of all tables, in order.
            before: numbers of rows before them, by table.

        Returns:
            How many inputs the machine took; it stops at one that it cannot take.
        """
        replay = self._core
        tables = {table: np.ascontiguousarray(rows) for table, rows in owned.items()}
        for number, table in enumerate(tables):
            replay.tables[number] = _recorded_table(table, tables[table])
        for number in range(len(tables), 4):
            replay.tables[number].count = 0
        order = np.ascontiguousarray(order, np.int64)
        self._sent = np.empty(((1 + self._is_network) * len(order), replay.sent_width), np.int64)
        replay.order, replay.count = pointer_to(order, "int64_t *"), len(order)
        replay.sent, replay.sent_count = pointer_to(self._sent, "int64_t *"), 0
        replay.next = 0
        if (wrong := core.noack_replay_check(replay)) != ffi.NULL:
            raise ValueError(f"replay: {ffi.string(wrong).decode()}")
        locate = _InputRows(tables, order, before)
        if not isinstance(self._machine, RunChannel):
            self._machine.before_answer = lambda part: self._recall(part, locate)
        try:
            while (reason := core.noack_replay_inputs(replay)) != core.NOACK_DONE:
                if reason == core.NOACK_CANNOT_TAKE:
                    raise ValueError("no run has these numbers")
                if reason == core.NOACK_REPLAY_SETTING:
                    self._announce(locate)
                elif isinstance(self._machine, RunChannel):
                    self._machine.answer(reason)
                else:
                    self._machine.raise_failure()
        except _DAMAGE as error:
            self._explain(locate)
            self._note(locate, replay.next, f"the machine cannot take this input: {error}")
        self._explain(locate)
        replay.difference = core.NOACK_EQUAL
        if self._is_network:
            self._machine.take_rows()
        return int(replay.next)

    def sent_in(self, flow: Flow) -> Numbers:
        """Return the messages of a flow that the machine sent in the newest part, (k, 3 + n).

        The words of a message are its sequence number, its time, its vector's n entries, and its
        error level.
        """
        sent = self._sent[: self._core.sent_count]
        is_of_flow = sent[:, 0] == flow
        words = sent if is_of_flow.all() else sent[is_of_flow]
        return words[:, 1 : _HEADER_WORDS + self._sizes.get(flow, 0) + 1]

    def forwarded(self) -> tuple[Numbers, NDArray[np.void]]:
        """Return flows and heads of the datagrams that left the network in the newest part."""
        sent = self._sent[: self._core.sent_count]
        heads = np.ascontiguousarray(sent[:, 1:]).view(f"V{PACKET_HEAD_BYTES}")
        return sent[:, 0], heads[:, 0]

    def _recall(self, part: MachinePart, locate: "_InputRows") -> None:
        """Let a part that is outside of noack answer as recorded."""
        if (asked := part.external) is not None:
            table, row, rows = locate(self._core.next)
            if table in _ANSWERS:
                asked.recorded = rows[_ANSWERS[table]][row].copy()

    def _announce(self, locate: "_InputRows") -> None:
        """Let the machine receive a change of settings; compare its row."""
        replay = self._core
        table, row, rows = locate(replay.next)
        recorded = rows[row]
        change = ParameterChange(
            int(recorded["sequence"]),
            int(recorded["t_ns"]),
            _settings(recorded["change"].tobytes()),
        )
        outputs = self._machine.announce(change, int(recorded["now_ns"]))
        (emitted,) = (output for output in outputs if type(output) is Record)
        values = emitted.row if self._is_network else emitted.row[1:]  # without the loop's number
        replayed = np.zeros(1, rows.dtype)[0]
        for name, value in zip(_own_names(rows.dtype), values, strict=True):
            replayed[name] = value
        if LOOP in (rows.dtype.names or ()):
            replayed[LOOP] = recorded[LOOP]
        if replay.difference == core.NOACK_EQUAL and replayed.tobytes() != recorded.tobytes():
            self._explain(locate)
            first_difference = first_row_difference(table, locate.number(table, row), recorded, replayed)
            self.difference = self.difference or first_difference
        replay.before_ns = int(recorded["now_ns"])
        replay.next += 1

    def _explain(self, locate: "_InputRows") -> None:
        """Keep the first difference that the core has found."""
        replay = self._core
        if self.difference is not None or replay.difference == core.NOACK_EQUAL:
            return
        at, other = replay.difference_at, replay.other_ns
        other_ns = None if other == NEVER_NS else other
        table, row, rows = locate(at)
        now_ns = int(rows["now_ns"][row])
        if replay.difference == core.NOACK_TIME_RUNS_BACKWARD:
            self._note(locate, at, "time runs backward", "now_ns", now_ns, other_ns)
        elif replay.difference == core.NOACK_BEFORE_DEADLINE:
            self._note(locate, at, "acted before its deadline", "now_ns", now_ns, other_ns)
        elif replay.difference == core.NOACK_OTHER_TABLE:
            self._note(locate, at, "the machine does not answer with one row of this table")
        else:
            replayed = rows[row : row + 1].copy()
            own = replayed.view(np.uint8).reshape(-1)
            skipped = _prefix_bytes(rows.dtype)
            own[skipped:] = np.frombuffer(ffi.buffer(replay.replayed), np.uint8)[: len(own) - skipped]
            number = locate.number(table, row)
            self.difference = first_row_difference(table, number, rows[row], replayed[0])

    def _note(self, locate: "_InputRows", at: int, text: str, column: str = "", *values: int | None) -> None:
        """Keep a difference at an input, if it is the first one."""
        table, row, rows = locate(at)
        number, now_ns = locate.number(table, row), int(rows["now_ns"][row])
        if self.difference is None:
            self.difference = difference(table, number, now_ns, text, column, *values)


class _InputRows:
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


def table_and_row(owned: Slice, row: int) -> tuple[str, int]:
    """Return table and row of an index among the rows of all tables."""
    for table, rows in owned.items():
        if row < len(rows):
            return table, row
        row -= len(rows)
    raise IndexError("the tables have fewer rows")


def received_columns(table: str, dtype: np.dtype[np.void]) -> list[str]:
    """Return the columns with the vector of a received message, in its order."""
    names = dtype.names or ()
    if table == SENSOR_ACKNOWLEDGEMENT:
        return []
    if RECEIVES[OWNER[table]] is Flow.ACTUATION:
        return [column for column in ("u", "predicted", "x_c") if column in names]
    return ["y", "u_applied"] if "y" in names else ["x"]


def received_words(table: str, rows: Rows) -> tuple[Numbers, list[str]]:
    """Return the words of the received messages, (k, 2 + n), and the names of the n entries."""
    columns = received_columns(table, rows.dtype)
    names = [entry for name in columns for entry in entry_names(name, rows.dtype[name].shape[0])]
    words = np.empty((len(rows), VECTOR + len(names)), np.int64)
    words[:, SEQUENCE], words[:, TIME] = rows["sequence"], rows["t_ns"]
    first = VECTOR
    for name in columns:
        last = first + rows.dtype[name].shape[0]
        words[:, first:last].view(np.float64)[...] = rows[name]
        first = last
    return words, names


def _recorded_table(table: str, rows: Rows) -> dict[str, object]:
    """Return a ``noack_recorded_table``; it is valid while the rows live."""
    skipped, stride = _prefix_bytes(rows.dtype), rows.dtype.itemsize
    vector: list[tuple[int, int]] = []
    if table in SETTINGS:
        kind = core.NOACK_SETTINGS
    elif table in _TIMERS:
        kind = core.NOACK_TICKS
    elif table == SENSOR_ACKNOWLEDGEMENT:
        kind = core.NOACK_ACKNOWLEDGEMENTS
    else:
        kind = core.NOACK_MESSAGES
        if OWNER[table] != "netem" and (fields := rows.dtype.fields) is not None:
            columns = (fields[column] for column in received_columns(table, rows.dtype))
            vector = [(offset - skipped, of.shape[0]) for of, offset, *_ in columns]
    return {
        "kind": kind,
        "row_bytes": stride - skipped,
        "stride": stride,
        "count": len(rows),
        "rows": pointer_to(rows, "uint8_t *") + skipped,
        "vector": vector,
    }


def _own_names(dtype: np.dtype[np.void]) -> Sequence[str]:
    return [name for name in dtype.names or () if name != LOOP]


def _prefix_bytes(dtype: np.dtype[np.void]) -> int:
    return dtype[LOOP].itemsize if LOOP in (dtype.names or ()) else 0


def _settings(data: bytes) -> dict[str, object]:
    """Return the changes of settings without the invalid ones of a damaged record."""
    try:
        return settings_of(data)
    except ValueError:
        return {"": None}


_MACHINES: Mapping[str, Callable[..., LoopMachines]] = {
    "plant": plants_of,
    "sensor": sensors_of,
    "controller": controllers_of,
}


class SharedMachines:
    """The machines of several loops without changes of settings, which are made at once.

    Args:
        records: the records of the loops, each in memory as a whole.
    """

    def __init__(self, records: Sequence[RunRecord]) -> None:
        shared = [record for record in records if record.is_short and not any(map(record.count, SETTINGS))]
        self._loops = [record.scenario for record in shared]
        self._indices = {record.number: index for index, record in enumerate(shared)}

    def index(self, record: RunRecord) -> int | None:
        """Return the index of a loop among the machines; None if they do not have it."""
        return self._indices.get(record.number)

    @cached_method
    def of(self, role: str) -> LoopMachines:
        """Return the machines of a role."""
        return _MACHINES[role](self._loops)


class MachineReplay:
    """Replays the machine of a role, part by part of the record.

    The machine gets its recorded inputs, up to the first gap, and its rows are compared.
    """

    def __init__(self, role: str, record: RunRecord, shared: SharedMachines) -> None:
        self._role, self._record, self._shared = role, record, shared
        counts, report = record.row_counts(role), record.reports.get(role)
        self._run: InputReplay | None = None
        self._count = sum(counts.values())
        self._written = None if report is None else sum(report["rows"][table] for table in counts)
        ends_early = self._written is not None and self._written > self._count
        self._missing_from = self._count if ends_early else None
        self._damage: ReplayDifference | None = None
        self._compared = 0
        self._before = dict.fromkeys(counts, 0)
        """Rows in the parts before, by table."""
        self._stopped = False
        self.newest: InputReplay | None = None
        """The replay of the newest part, which has what was sent; None if there was nothing to replay."""

    def take(self, part: Slice) -> None:
        """Replay the next part of the record, unless the replay has stopped before."""
        self.newest = None
        owned = {table: part[table] for table in self._before}
        if self._stopped or not any(map(len, owned.values())):
            return
        order = self._in_order(owned)
        if self._run is None:
            self._run = self._begin()
        compared = self._run.replay(owned, order, self._before)
        self._stopped |= compared < len(order)
        self._compared += compared
        for table, rows in owned.items():
            self._before[table] += len(rows)
        self.newest = self._run

    def _begin(self) -> InputReplay:
        """Return the replay of a new machine."""
        role, scenario = self._role, self._record.scenario
        sizes = _sizes(role, scenario)
        if role == "netem":
            return InputReplay(role, channel_of(scenario, loops=len(loop_names(scenario))), sizes)
        if (index := self._shared.index(self._record)) is not None:
            return InputReplay(role, self._shared.of(role), sizes, index)
        return InputReplay(role, _MACHINES[role]((scenario,)), sizes)

    @property
    def result(self) -> ProcessReplay:
        """The result; final after the last part."""
        differs = None if self._run is None else self._run.difference
        differences = [first for first in (differs, self._damage) if first is not None]
        return ProcessReplay(
            process=self._role,
            inputs=self._count,
            compared=self._compared,
            missing_from=self._missing_from,
            end_known=self._written is not None,
            difference=min(differences, key=lambda difference: difference.now_ns, default=None),
        )

    def _in_order(self, owned: Slice) -> Numbers:
        """Return the indices of the inputs in order, among the rows of all tables, up to a gap."""
        numbers = np.concatenate([rows["input"] for rows in owned.values()])
        order = np.argsort(numbers, kind="stable")
        numbers = numbers[order]
        unexpected = np.flatnonzero(numbers != self._compared + np.arange(len(numbers)))
        if not len(unexpected):
            return order
        first_gap = int(unexpected[0])
        self._stopped = True
        self._explain(owned, order, numbers, first_gap)
        return order[:first_gap]

    def _explain(self, owned: Slice, order: Numbers, numbers: Numbers, first_gap: int) -> None:
        """Find out whether rows are missing before ``first_gap``, or its input number is wrong."""
        expected, suspect = self._compared + first_gap, first_gap
        complete = self._written == self._count
        if numbers[first_gap] > expected:
            if not complete:
                self._missing_from = expected
                return
            # No row is missing, so an ``input`` number is wrong.
            repeated = np.append(np.diff(numbers) == 0, False)
            wrong = np.flatnonzero(repeated | (numbers >= self._count))
            suspect = int(wrong[0]) if len(wrong) else first_gap
        self._missing_from = None
        table, row = table_and_row(owned, int(order[suspect]))
        self._damage = difference(
            table,
            self._before[table] + row,
            int(owned[table]["now_ns"][row]),
            "the inputs are not numbered in turn",
            "input",
            int(numbers[suspect]),
            expected,
        )


def _sizes(role: str, scenario: Scenario) -> Mapping[Flow, int]:
    """Return the entries of the vectors that a machine sends, by flow."""
    if role == "netem":
        return {}
    sizes = {SENDS[role]: scenario.message_sizes.entries(SENDS[role])}
    return sizes | ({Flow.ACKNOWLEDGEMENT: 0} if role == "controller" else {})

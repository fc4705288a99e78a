"""Replays machines from their recorded rows and compares the rows that they emit."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from controller_node.controller import controller_of
from cosim.analysis.replay.compiled_replay import compiled_machine
from cosim.analysis.replay.replay_result import ProcessReplay, difference, rows_differ
from cosim.analysis.summary_model import ReplayDifference
from cosim.record.process_lives import Life
from cosim.record.record_source import Slice
from cosim.record.run_record import Rows, RunRecord
from netem.duplex_link import network_of
from netem.link_machine import Datagram
from noack.config.loops import loops_of
from noack.config.parameter_changes import ParameterChange, settings_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.protocol.machine_interface import GENERATION, Machine, Notice, Record, Start
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NETEM_PACKET,
    NETEM_RELEASE,
    OWNER,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SETTINGS,
    entry_names,
)
from noack.protocol.topology import RECEIVES, SENDS
from noack.protocol.wire_format import Flow, Message
from noack.runtime.fleet.fleet_replay import FleetReplay, Numbers, SentMessages
from plant_server.plant import plant_of
from sensor_node.sensor import sensor_of

_MACHINES: Mapping[str, Callable[[Scenario, Start], Machine[Any]]] = {
    "plant": lambda scenario, _: plant_of(scenario),
    "sensor": sensor_of,
    "netem": lambda scenario, start: network_of(scenario, start, loops=len(loops_of(scenario))),
    "controller": controller_of,
}
_TIMERS = (PLANT_STEP, CONTROLLER_STEP, NETEM_RELEASE)
_MOST_BYTES = 65_535
"""Largest size of a datagram; a damaged record may contain larger numbers."""


_NOT_SENT = (Record, Notice)
_ANSWER_RANK, _LAST_RANK = 2, 3  # of several differences at one input, the first counts
_DAMAGE = (ArithmeticError, LookupError, ValueError, CallerError)
"""Errors of a machine that gets an input from a damaged record, which no run can have."""


class UnequalError(Exception):
    """A compiled machine did not emit the recorded rows; the single machines show where."""


def sent_messages(messages: Sequence[Message]) -> SentMessages:
    """Return messages of one flow as arrays."""
    return SentMessages(
        np.array([message.sequence for message in messages], np.int64),
        np.array([message.t_ns for message in messages], np.int64),
        np.array([message.vector for message in messages], np.float64),
    )


def received_vectors(table: str, rows: Rows) -> tuple[Matrix, list[str]]:
    """Return the vectors of the received messages, (k, n), and the names of their entries."""
    names, columns = rows.dtype.names or (), ["x"]
    if table == SENSOR_ACKNOWLEDGEMENT:
        columns = []
    elif RECEIVES[OWNER[table]] is Flow.ACTUATION:
        columns = [column for column in ("u", "predicted", "x_c") if column in names]
    elif "y" in names:
        columns = ["y", "u_applied"]
    vectors = np.hstack([np.zeros((len(rows), 0)), *(rows[column] for column in columns)])
    return vectors, [
        entry for column in columns for entry in entry_names(column, rows[column].shape[1])
    ]


class MachineReplay:
    """Replays the machines of a role, part by part of the record; one for each generation.

    Each machine gets its recorded inputs, up to the first gap, and its rows are compared.
    """

    def __init__(self, role: str, record: RunRecord, *, compiled: bool = False) -> None:
        self._tables = record.owned_by(role)
        self._numbers = record.life_numbers(role)
        self._lives = [
            _LifeReplay(role, record.scenario, life, compiled=compiled)
            for life in record.lives(role)
        ]
        self.sent: list[Any] = []
        """Messages that the single machines emitted in the newest part."""
        self._sent: list[SentMessages] = []
        self._flow = SENDS.get(role)

    def take(self, part: Slice) -> None:
        """Replay the next part of the record."""
        self.sent, self._sent = [], []
        places = {table: self._numbers.places(part[table]) for table in self._tables}
        for i, life in enumerate(self._lives):
            owned = {table: part[table][places[table] == i] for table in self._tables}
            if any(map(len, owned.values())):
                sent = life.take(owned)
                if isinstance(sent, SentMessages):
                    self._sent.append(sent)
                else:
                    self.sent += sent

    def sent_in(self, flow: Flow) -> list[SentMessages]:
        """Return the messages of a flow that the machines emitted in the newest part."""
        found = [message for message in self.sent if message.flow is flow]
        single = [sent_messages(found)] if found else []
        return single + (self._sent if flow is self._flow else [])

    @property
    def results(self) -> tuple[ProcessReplay, ...]:
        """The result of each generation; final after the last part."""
        return tuple(life.result() for life in self._lives)

    @property
    def whole(self) -> bool:
        """Whether every input was replayed."""
        return all(result.whole for result in self.results)


class _LifeReplay:
    """The replay of one generation."""

    def __init__(self, role: str, scenario: Scenario, life: Life, *, compiled: bool) -> None:
        self._role, self._scenario, self._life = role, scenario, life
        self._run: _Run | None = None
        self._compiled = None
        if compiled and not life.generation:
            self._compiled = compiled_machine(role, scenario)
        self._now_ns: int | None = None
        self._count = sum(life.rows.values())
        report = life.report
        self._written = None if report is None else sum(report["rows"][one] for one in life.rows)
        ends_early = self._written is not None and self._written > self._count
        self._missing_from = self._count if ends_early else None
        self._damage: ReplayDifference | None = None
        self._compared = 0
        self._before = dict.fromkeys(life.rows, 0)
        """Rows in the parts before, by table."""
        self._stopped = False

    def take(self, owned: Slice) -> list[Any] | SentMessages:
        """Replay the next rows; return the messages that the machine emitted.

        Raises:
            UnequalError: the compiled machine did not emit these rows.
        """
        if self._stopped:
            return []
        order = self._in_order(owned)
        sent: list[Any] | SentMessages
        if self._compiled is not None:
            taken, sent = len(order), self._take_compiled(self._compiled, owned, order)
        else:
            if self._run is None:
                start = _start(self._life.generation, owned)
                self._run = _Run(_MACHINES[self._role](self._scenario, start))
            taken = self._run.replay(owned, order, self._before)
            sent = self._run.sent
        self._stopped |= taken < len(order)
        self._compared += taken
        for table, rows in owned.items():
            self._before[table] += len(rows)
        return sent

    def _take_compiled(self, machine: FleetReplay, owned: Slice, order: Numbers) -> SentMessages:
        times = np.concatenate([rows["now_ns"] for rows in owned.values()])[order]
        before = times[:1] if self._now_ns is None else [self._now_ns]
        sent = None
        if (np.diff(times, prepend=before) >= 0).all():
            sent = machine.take(owned, order)
        if sent is None:
            raise UnequalError
        self._now_ns = int(times[-1]) if len(times) else self._now_ns
        return sent

    def result(self) -> ProcessReplay:
        generation, differs = (
            self._life.generation,
            None if self._run is None else self._run.difference,
        )
        found = [one for one in (differs, self._damage) if one is not None]
        return ProcessReplay(
            process=f"{self._role} ({generation + 1})" if generation else self._role,
            inputs=self._count,
            compared=self._compared,
            missing_from=self._missing_from,
            end_known=self._life.report is not None,
            difference=min(found, key=lambda one: one.now_ns, default=None),
        )

    def _in_order(self, owned: Slice) -> Numbers:
        """Return the places of the inputs in order, among the rows of all tables, up to a gap."""
        numbers = np.concatenate([rows["input"] for rows in owned.values()])
        numbers = numbers - self._life.generation * GENERATION
        order = np.argsort(numbers, kind="stable")
        numbers = numbers[order]
        unexpected = np.flatnonzero(numbers != self._compared + np.arange(len(numbers)))
        if not len(unexpected):
            return order
        whole = int(unexpected[0])
        self._stopped = True
        self._explain(owned, order, numbers, whole)
        return order[:whole]

    def _explain(self, owned: Slice, order: Numbers, numbers: Numbers, whole: int) -> None:
        """Find out whether rows are missing before ``whole``, or its input number is wrong."""
        expected, suspect = self._compared + whole, whole
        complete = self._written == self._count
        if numbers[whole] > expected:
            if not complete:
                self._missing_from = expected
                return
            # No row is missing, so an ``input`` number is wrong.
            repeated = np.append(np.diff(numbers) == 0, False)
            wrong = np.flatnonzero(repeated | (numbers >= self._count))
            suspect = int(wrong[0]) if len(wrong) else whole
        self._missing_from = None
        table, row = _table_and_row(owned, int(order[suspect]))
        self._damage = difference(
            table, self._before[table] + row, int(owned[table]["now_ns"][row]),
            "the inputs are not numbered in turn", "input", int(numbers[suspect]), expected,
        )  # fmt: skip


def _table_and_row(owned: Slice, place: int) -> tuple[str, int]:
    """Return table and row of a place among the rows of all tables."""
    for table, rows in owned.items():
        if place < len(rows):
            return table, place
        place -= len(rows)
    raise IndexError("the tables have fewer rows")


def _start(generation: int, owned: Slice) -> Start:
    """Return the start of a process: for the controller, its first tick.

    If the controller died before its first tick, its first message determines the start.
    """
    if not generation or CONTROLLER_STEP not in owned:
        return Start(generation)
    steps, deliveries = owned[CONTROLLER_STEP], owned[CONTROLLER_DELIVERY]
    first_ns = (*steps["t_ns"][:1], *deliveries["model_t_ns"][:1])
    return Start(generation, int(min(first_ns, default=0)))


class _Run:
    """A machine under replay."""

    def __init__(self, machine: Machine[Any]) -> None:
        self.difference: ReplayDifference | None = None
        self.sent: list[Any] = []
        """Messages that the machine emitted in the newest part."""
        self._machine = machine
        self._before_ns: int | None = None

    def replay(self, owned: Slice, order: Numbers, before: Mapping[str, int]) -> int:
        """Feed the next inputs, and compare the rows.

        Args:
            owned: the next rows by table.
            order: places of the inputs among the rows of all tables, in order.
            before: numbers of rows before them, by table.

        Returns:
            How many inputs the machine took; it stops at one that it cannot take.
        """
        self._owned, self._order, self._offsets = owned, order.tolist(), before
        self._found: list[tuple[int, int, ReplayDifference]] = []
        outputs = self._feed(order)
        taken = self._compare(outputs)
        if self.difference is None:
            self.difference = min(self._found, key=lambda one: one[:2], default=(0, 0, None))[2]
        self.sent = [
            one for each in outputs[:taken] for one in each if not isinstance(one, _NOT_SENT)
        ]
        return taken

    def _feed(self, order: Numbers) -> list[Sequence[Any]]:
        """Return the machine's outputs by input."""
        machine, outputs, before_ns = self._machine, list[Sequence[Any]](), self._before_ns
        times = np.concatenate([rows["now_ns"] for rows in self._owned.values()])[order].tolist()
        messages = [*itertools.chain(*itertools.starmap(_messages, self._owned.items()))]
        try:
            for i, now_ns in zip(self._order, times, strict=True):
                if before_ns is not None and now_ns < before_ns:
                    self._differs(
                        len(outputs), 0, "time runs backward", "now_ns", now_ns, before_ns
                    )
                before_ns = now_ns
                message = messages[i]
                if message is None:
                    due_ns = machine.next_deadline_ns()
                    if due_ns is None or now_ns < due_ns:
                        what = "acted before its deadline"
                        self._differs(len(outputs), 1, what, "now_ns", now_ns, due_ns)
                    outputs.append(machine.on_timer(now_ns))
                elif isinstance(message, ParameterChange):
                    outputs.append(machine.announce(message, now_ns))  # type: ignore[attr-defined]
                else:
                    outputs.append(machine.handle(message, now_ns))
        except _DAMAGE as error:
            self._cannot_take(len(outputs), error)
        self._before_ns = before_ns
        return outputs

    def _compare(self, outputs: Sequence[Sequence[Any]]) -> int:
        """Compare the emitted rows; return how many inputs the machine took."""
        taken, order = len(outputs), np.array(self._order[: len(outputs)], np.int64)
        answers = [[one for one in each if type(one) is Record] for each in outputs]
        begin = 0
        for table, rows in self._owned.items():
            at = np.flatnonzero((order >= begin) & (order < begin + len(rows)))
            mine = [answers[place] for place in at.tolist()]
            right = [len(one) == 1 and one[0].table == table for one in mine]
            if not all(right):
                what = "the machine does not answer with one row of this table"
                self._differs(int(at[right.index(False)]), _ANSWER_RANK, what)
                at, mine = at[right], [one for one, fits in zip(mine, right, strict=True) if fits]
            recorded = rows[order[at] - begin]
            begin += len(rows)
            fresh, error = rows_of([record.row for (record,) in mine], rows.dtype)
            if error is not None:
                self._cannot_take(place := int(at[len(fresh)]), error)
                taken = min(taken, place)
            if (first := first_other(recorded[: len(fresh)], fresh)) is not None:
                _, row = self._row(place := int(at[first]))
                row += self._offsets[table]
                found = rows_differ(table, row, recorded[first], fresh[first])
                self._found.append((place, _ANSWER_RANK, found))
        return taken

    def _row(self, place: int) -> tuple[str, int]:
        return _table_and_row(self._owned, self._order[place])

    def _cannot_take(self, place: int, error: Exception) -> None:
        # A damaged record has values that no run can have.
        self._differs(place, _LAST_RANK, f"the machine cannot take this input: {error}")

    def _differs(self, place: int, rank: int, what: str, *values: Any) -> None:
        """Store a difference at an input; of several there, that of the least rank counts."""
        if rank < _ANSWER_RANK and any(known == rank for _, known, _ in self._found):
            return
        table, row = self._row(place)
        now_ns = int(self._owned[table]["now_ns"][row])
        found = difference(table, self._offsets[table] + row, now_ns, what, *values)
        self._found.append((place, rank, found))


def rows_of(
    emitted: Sequence[tuple[Any, ...]], dtype: np.dtype[np.void]
) -> tuple[Rows, Exception | None]:
    """Return emitted rows as rows of a table, up to the first that does not fit; and the error."""
    rows = np.zeros(len(emitted), dtype)
    try:
        for name, values in zip(dtype.names or (), zip(*emitted, strict=True), strict=True):
            field = dtype[name]
            if field.shape:
                rows[name] = np.concatenate(values).reshape(len(rows), *field.shape)
            else:
                rows[name] = np.array(values, field)
    except _DAMAGE:
        for i, row in enumerate(emitted):
            try:
                rows[i] = row
            except _DAMAGE as error:
                return rows[:i], error
    return rows, None


def first_other(one: Rows, other: Rows) -> int | None:
    """Return the first of k rows that differs in any bit; None if they are equal."""
    first, second = one.tobytes(), other.tobytes()
    if first == second:
        return None
    bits = (np.frombuffer(data, np.uint8).reshape(len(one), -1) for data in (first, second))
    return int(np.argmax((next(bits) != next(bits)).any(axis=1)))


def _messages(table: str, rows: Rows) -> Iterator[Message | Datagram | ParameterChange | None]:
    """Yield the machine's input of each row; None for its timer."""
    if table in _TIMERS:
        yield from itertools.repeat(None, len(rows))
    elif table in SETTINGS:
        for number, t_ns, data in zip(
            rows["sequence"].tolist(), rows["t_ns"].tolist(), rows["change"].tolist(), strict=True
        ):
            yield ParameterChange(number, t_ns, _settings(data))
    elif table == NETEM_PACKET:
        for flow, size, head, t_ns in zip(
            *(rows[name].tolist() for name in ("flow", "size_bytes", "head", "t_ns")), strict=True
        ):
            size_bytes = min(max(size, 0), _MOST_BYTES)
            yield Datagram(flow, head.ljust(size_bytes, b"\0")[:size_bytes], t_ns)
    else:
        acknowledges = table == SENSOR_ACKNOWLEDGEMENT
        flow = Flow.ACKNOWLEDGEMENT if acknowledges else RECEIVES[OWNER[table]]
        vectors, _ = received_vectors(table, rows)
        # The copy has the memory layout of the decoder's vector: rounding may depend on it.
        copies = (vector.copy() for vector in vectors)
        fields = rows["sequence"].tolist(), rows["t_ns"].tolist(), copies
        yield from map(Message, itertools.repeat(flow), *fields)


def _settings(data: bytes) -> dict[str, Any]:
    """Return the changes of settings without the invalid ones of a damaged record."""
    try:
        return settings_of(data)
    except ValueError:
        return {"": None}

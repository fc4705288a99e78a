"""Replays machines from their recorded rows and compares the rows that they emit."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node.controller import controller_of
from cosim.analysis.replay.replay_result import ProcessReplay, difference, rows_differ
from cosim.analysis.summary_model import ReplayDifference
from cosim.record.process_lives import Life
from cosim.record.record_source import Slice
from cosim.record.run_record import Rows, RunRecord
from netem.duplex_link import network_of
from netem.link_machine import Datagram
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
from noack.protocol.topology import ROUTES
from noack.protocol.wire_format import Flow, Message
from plant_server.plant import plant_of
from sensor_node.sensor import sensor_of

_MACHINES: Mapping[str, Callable[[Scenario, Start], Machine[Any]]] = {
    "plant": lambda scenario, _: plant_of(scenario),
    "sensor": sensor_of,
    "netem": network_of,
    "controller": controller_of,
}
_TIMERS = (PLANT_STEP, CONTROLLER_STEP, NETEM_RELEASE)
_MOST_BYTES = 65_535
"""Largest size of a datagram; a damaged record may contain larger numbers."""


Numbers = NDArray[np.int64]


def received_vectors(table: str, rows: Rows) -> tuple[Matrix, list[str]]:
    """Return the vectors of the received messages, (k, n), and the names of their entries."""
    names, columns = rows.dtype.names or (), ["x"]
    if table == SENSOR_ACKNOWLEDGEMENT:
        columns = []
    elif ROUTES[OWNER[table]].receives is Flow.ACTUATION:
        columns = [column for column in ("u", "x_c") if column in names]
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

    def __init__(self, role: str, record: RunRecord) -> None:
        self._tables = record.owned_by(role)
        self._numbers = record.life_numbers(role)
        self._lives = [_LifeReplay(role, record.scenario, life) for life in record.lives(role)]
        self.sent: list[Any] = []
        """Messages that the machines emitted in the newest part."""

    def take(self, part: Slice) -> None:
        """Replay the next part of the record."""
        self.sent = []
        places = {table: self._numbers.places(part[table]) for table in self._tables}
        for i, life in enumerate(self._lives):
            owned = {table: part[table][places[table] == i] for table in self._tables}
            if any(map(len, owned.values())):
                self.sent += life.take(owned)

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

    def __init__(self, role: str, scenario: Scenario, life: Life) -> None:
        self._role, self._scenario, self._life = role, scenario, life
        self._run: _Run | None = None
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

    def take(self, owned: Slice) -> list[Any]:
        """Replay the next rows; return the messages that the machine emitted."""
        if self._stopped:
            return []
        if self._run is None:
            start = _start(self._life.generation, owned)
            self._run = _Run(_MACHINES[self._role](self._scenario, start))
        order = self._in_order(owned)
        self._run.load(owned, self._before)
        for table, row in order:
            if not self._run.step(table, row):
                self._stopped = True
                break
            self._compared += 1
        for table, rows in owned.items():
            self._before[table] += len(rows)
        return self._run.take_sent()

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

    def _in_order(self, owned: Slice) -> list[tuple[str, int]]:
        """Return table and row of each input in order, up to the first gap."""
        numbers = np.concatenate([rows["input"] for rows in owned.values()])
        numbers = numbers - self._life.generation * GENERATION
        places = [(table, row) for table, rows in owned.items() for row in range(len(rows))]
        order = np.argsort(numbers, kind="stable")
        numbers = numbers[order]
        in_order = [places[i] for i in order.tolist()]
        unexpected = np.flatnonzero(numbers != self._compared + np.arange(len(numbers)))
        if not len(unexpected):
            return in_order
        whole = int(unexpected[0])
        self._stopped = True
        self._explain(owned, in_order, numbers, whole)
        return in_order[:whole]

    def _explain(
        self, owned: Slice, in_order: list[tuple[str, int]], numbers: Numbers, whole: int
    ) -> None:
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
        table, row = in_order[suspect]
        self._damage = difference(
            table, self._before[table] + row, int(owned[table]["now_ns"][row]),
            "the inputs are not numbered in turn", "input", int(numbers[suspect]), expected,
        )  # fmt: skip


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
        self._sent: list[Any] = []
        self.difference: ReplayDifference | None = None
        self._machine = machine
        self._before_ns: int | None = None

    def load(self, owned: Slice, before: Mapping[str, int]) -> None:
        """Load the next rows; ``before`` are the numbers of rows before them, by table."""
        self._offsets = dict(before)
        self._rows = {table: np.ascontiguousarray(rows) for table, rows in owned.items()}
        self._recorded = {table: rows.tobytes() for table, rows in self._rows.items()}
        self._now_ns = {table: rows["now_ns"].tolist() for table, rows in owned.items()}
        self._messages = {table: list(_messages(table, rows)) for table, rows in owned.items()}
        self._fresh = {table: np.zeros(1, rows.dtype) for table, rows in owned.items()}

    def take_sent(self) -> list[Any]:
        """Return the messages that were emitted since the last call."""
        sent, self._sent = self._sent, []
        return sent

    def step(self, table: str, row: int) -> bool:
        """Feed one input; return whether the machine took it."""
        now_ns, message = self._now_ns[table][row], self._messages[table][row]
        if self._before_ns is not None and now_ns < self._before_ns:
            self._differs(table, row, "time runs backward", "now_ns", now_ns, self._before_ns)
        self._before_ns = now_ns
        try:
            if isinstance(message, ParameterChange):
                outputs = self._machine.announce(message, now_ns)  # type: ignore[attr-defined]
            elif message is None:
                due_ns = self._machine.next_deadline_ns()
                if due_ns is None or now_ns < due_ns:
                    self._differs(table, row, "acted before its deadline", "now_ns", now_ns, due_ns)
                outputs = self._machine.on_timer(now_ns)
            else:
                outputs = self._machine.handle(message, now_ns)
            self._compare(table, row, outputs)
        except (ArithmeticError, LookupError, ValueError, CallerError) as error:
            # A damaged record has values that no run can have.
            self._differs(table, row, f"the machine cannot take this input: {error}")
            return False
        return True

    def _compare(self, table: str, row: int, outputs: Sequence[Any]) -> None:
        emitted = [output for output in outputs if isinstance(output, Record)]
        self._sent += [output for output in outputs if not isinstance(output, Record | Notice)]
        if [record.table for record in emitted] != [table]:
            self._differs(table, row, "the machine does not answer with one row of this table")
            return
        fresh = self._fresh[table]
        fresh[0] = emitted[0].row
        size = fresh.itemsize
        same = fresh.tobytes() == self._recorded[table][row * size : (row + 1) * size]
        if not same and self.difference is None:
            place = self._offsets[table] + row
            self.difference = rows_differ(table, place, self._rows[table][row], fresh[0])

    def _differs(self, table: str, row: int, what: str, *values: Any) -> None:
        if self.difference is None:
            now_ns, place = self._now_ns[table][row], self._offsets[table] + row
            self.difference = difference(table, place, now_ns, what, *values)


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
        for flow, size, head in zip(
            rows["flow"].tolist(), rows["size_bytes"].tolist(), rows["head"].tolist(), strict=True
        ):
            size_bytes = min(max(size, 0), _MOST_BYTES)
            yield Datagram(flow, head.ljust(size_bytes, b"\0")[:size_bytes])
    else:
        acknowledges = table == SENSOR_ACKNOWLEDGEMENT
        flow = Flow.ACKNOWLEDGEMENT if acknowledges else ROUTES[OWNER[table]].receives
        vectors, _ = received_vectors(table, rows)
        for sequence, t_ns, vector in zip(
            rows["sequence"].tolist(), rows["t_ns"].tolist(), vectors, strict=True
        ):
            # The copy has the memory layout of the decoder's vector: rounding may depend on it.
            yield Message(flow, sequence, t_ns, vector.copy())


def _settings(data: bytes) -> dict[str, Any]:
    """Return the changes of settings without the invalid ones of a damaged record."""
    try:
        return settings_of(data)
    except ValueError:
        return {"": None}

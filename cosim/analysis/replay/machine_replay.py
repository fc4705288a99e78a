"""Replays one machine from its recorded rows and compares the rows that it emits."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from controller_node.controller import controller_of
from cosim.analysis.replay.replay_result import ProcessReplay, difference, rows_differ
from cosim.analysis.summary_model import ReplayDifference
from cosim.record.run_record import Life, Rows, RunRecord
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


@dataclass(frozen=True)
class MachineReplay:
    """The replay of a role's machines: the result of each, and the messages that they emitted."""

    results: tuple[ProcessReplay, ...]
    sent: Sequence[Any]

    @property
    def whole(self) -> bool:
        """Whether every input was replayed."""
        return all(result.whole for result in self.results)


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


def replay_machine(role: str, record: RunRecord) -> MachineReplay:
    """Feed a process's machine its recorded inputs, up to the first gap, and compare its rows.

    If the process was restarted, the machine of each restarted process is replayed too.
    """
    sent: list[Any] = []
    results = [_replay_life(role, record.scenario, life, sent) for life in record.lives(role)]
    return MachineReplay(tuple(results), sent)


def _replay_life(role: str, scenario: Scenario, life: Life, sent: list[Any]) -> ProcessReplay:
    owned, first = life.rows, life.generation * GENERATION
    inputs = _inputs(owned, life.report, first)
    run = _Run(_MACHINES[role](scenario, _start(life)), owned)
    compared = 0
    for table, row in inputs.order:
        if not run.step(table, row):
            break
        compared += 1
    found = [one for one in (run.difference, inputs.damage) if one is not None]
    sent += run.sent
    return ProcessReplay(
        process=f"{role} ({life.generation + 1})" if life.generation else role,
        inputs=sum(map(len, owned.values())),
        compared=compared,
        missing_from=inputs.missing_from,
        end_known=life.report is not None,
        difference=min(found, key=lambda one: one.now_ns, default=None),
    )


def _start(life: Life) -> Start:
    """Return the start of a process: for the controller, its first tick.

    If the controller died before its first tick, its first message determines the start.
    """
    if not life.generation or CONTROLLER_STEP not in life.rows:
        return Start(life.generation)
    steps, deliveries = life.rows[CONTROLLER_STEP], life.rows[CONTROLLER_DELIVERY]
    first_ns = (*steps["t_ns"][:1], *deliveries["model_t_ns"][:1])
    return Start(life.generation, int(min(first_ns, default=0)))


class _Inputs(NamedTuple):
    order: list[tuple[str, int]]
    """Table and row of each input, up to the first gap."""
    missing_from: int | None
    damage: ReplayDifference | None


def _inputs(owned: Mapping[str, Rows], report: Mapping[str, Any] | None, first: int) -> _Inputs:
    """Put the rows of a process's tables in the order of their ``input`` numbers."""
    numbers = np.concatenate([rows["input"] for rows in owned.values()]) - first
    places = [(table, row) for table, rows in owned.items() for row in range(len(rows))]
    order = np.argsort(numbers, kind="stable")
    numbers, count = numbers[order], len(numbers)
    written = None if report is None else sum(report["rows"][table] for table in owned)
    missing_from = None if written is None or written <= count else count
    damage = None
    unexpected = np.flatnonzero(numbers != np.arange(count))
    whole = int(unexpected[0]) if len(unexpected) else count
    if whole < count:
        suspect = whole
        if numbers[whole] > whole:
            missing_from = whole
            if written == count:  # no row is missing, so an ``input`` number is wrong
                repeated = np.append(np.diff(numbers) == 0, False)
                suspect = int(np.flatnonzero(repeated | (numbers >= count))[0])
        if numbers[whole] < whole or written == count:
            missing_from = None
            table, row = places[order[suspect]]
            damage = difference(
                table, row, int(owned[table]["now_ns"][row]), "the inputs are not numbered in turn",
                "input", int(numbers[suspect]), whole,
            )  # fmt: skip
    return _Inputs([places[i] for i in order[:whole].tolist()], missing_from, damage)


class _Run:
    """A machine under replay."""

    def __init__(self, machine: Machine[Any], owned: Mapping[str, Rows]) -> None:
        self.sent: list[Any] = []
        self.difference: ReplayDifference | None = None
        self._machine = machine
        self._rows = {table: np.ascontiguousarray(rows) for table, rows in owned.items()}
        self._recorded = {table: rows.tobytes() for table, rows in self._rows.items()}
        self._now_ns = {table: rows["now_ns"].tolist() for table, rows in owned.items()}
        self._messages = {table: list(_messages(table, rows)) for table, rows in owned.items()}
        self._fresh = {table: np.zeros(1, rows.dtype) for table, rows in owned.items()}
        self._before_ns: int | None = None

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
        self.sent += [output for output in outputs if not isinstance(output, Record | Notice)]
        if [record.table for record in emitted] != [table]:
            self._differs(table, row, "the machine does not answer with one row of this table")
            return
        fresh = self._fresh[table]
        fresh[0] = emitted[0].row
        size = fresh.itemsize
        same = fresh.tobytes() == self._recorded[table][row * size : (row + 1) * size]
        if not same and self.difference is None:
            self.difference = rows_differ(table, row, self._rows[table][row], fresh[0])

    def _differs(self, table: str, row: int, what: str, *values: Any) -> None:
        if self.difference is None:
            now_ns = self._now_ns[table][row]
            self.difference = difference(table, row, now_ns, what, *values)


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

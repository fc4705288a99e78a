"""Replays machines from their recorded rows and compares the rows that they emit."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from controller_node.controller import controller_of
from cosim.analysis.replay.compiled_replay import compiled_machine
from cosim.analysis.replay.replay_result import ProcessReplay, difference
from cosim.analysis.replay.single_machine_replay import SingleMachineReplay, table_and_row
from cosim.analysis.summary_model import ReplayDifference
from cosim.record.process_lives import Life
from cosim.record.record_source import Slice
from cosim.record.run_record import RunRecord
from netem.duplex_link import network_of
from noack.config.loops import loops_of
from noack.config.scenario import Scenario
from noack.protocol.machine_interface import GENERATION, Machine, Start
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
)
from noack.protocol.topology import SENDS
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


class UnequalError(Exception):
    """A compiled machine did not emit the recorded rows; the single machines show where."""


def sent_messages(messages: Sequence[Message]) -> SentMessages:
    """Return messages of one flow as arrays."""
    return SentMessages(
        np.array([message.sequence for message in messages], np.int64),
        np.array([message.t_ns for message in messages], np.int64),
        np.array([message.vector for message in messages], np.float64),
    )


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
        self._run: SingleMachineReplay | None = None
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
                self._run = SingleMachineReplay(_MACHINES[self._role](self._scenario, start))
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
        table, row = table_and_row(owned, int(order[suspect]))
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

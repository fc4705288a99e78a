"""Replays machines from their recorded rows, generation by generation, up to the first gap."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from controller_node.controller import controllers_of
from cosim.analysis.replay.input_replay import InputReplay, Numbers, table_and_row
from cosim.analysis.replay.replay_result import ProcessReplay, difference
from cosim.analysis.summary_model import ReplayDifference
from cosim.record.process_lives import RowCounts
from cosim.record.record_source import Slice
from cosim.record.run_record import RunRecord
from netem.channel import Channel, channel_of
from noack.config.scenario import Scenario, loops_of
from noack.machines.loop_machines import LoopMachines
from noack.protocol.machine_interface import GENERATION, Start
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
)
from noack.protocol.topology import SENDS
from noack.protocol.wire_format import Flow
from plant_server.plant import plants_of
from sensor_node.sensor import sensors_of

_MACHINES: Mapping[str, Callable[[Scenario, Start], LoopMachines | Channel]] = {
    "plant": lambda loop, start: plants_of((loop,), start=start),
    "sensor": lambda loop, start: sensors_of((loop,), start=start),
    "netem": lambda scenario, start: channel_of(scenario, start, loops=len(loops_of(scenario))),
    "controller": lambda loop, start: controllers_of((loop,), start=start),
}


class MachineReplay:
    """Replays the machines of a role, part by part of the record; one for each generation.

    Each machine gets its recorded inputs, up to the first gap, and its rows are compared.
    """

    def __init__(self, role: str, record: RunRecord) -> None:
        self._tables = record.owned_by(role)
        self._numbers = record.life_numbers(role)
        self._lives = [_LifeReplay(role, record.scenario, life) for life in record.row_counts(role)]
        self.newest: list[InputReplay] = []
        """The replays of the newest part; they have what was sent."""

    def take(self, part: Slice) -> None:
        """Replay the next part of the record."""
        self.newest = []
        for owned, life in zip(self._by_life(part), self._lives, strict=True):
            if any(map(len, owned.values())):
                self.newest += life.take(owned)

    def _by_life(self, part: Slice) -> Iterator[Slice]:
        """Yield the rows of each generation."""
        owned = {table: part[table] for table in self._tables}
        if len(self._lives) == 1:
            yield owned
            return
        places = {table: self._numbers.places(rows) for table, rows in owned.items()}
        for i in range(len(self._lives)):
            yield {table: rows.compress(places[table] == i) for table, rows in owned.items()}

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

    def __init__(self, role: str, scenario: Scenario, life: RowCounts) -> None:
        self._role, self._scenario, self._life = role, scenario, life
        self._run: InputReplay | None = None
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

    def take(self, owned: Slice) -> list[InputReplay]:
        """Replay the next rows; return the replay, unless it has stopped before."""
        if self._stopped:
            return []
        order = self._in_order(owned)
        if self._run is None:
            start = _start(self._life.generation, owned)
            machine = _MACHINES[self._role](self._scenario, start)
            self._run = InputReplay(self._role, machine, _sizes(self._role, self._scenario))
        taken = self._run.replay(owned, order, self._before)
        self._stopped |= taken < len(order)
        self._compared += taken
        for table, rows in owned.items():
            self._before[table] += len(rows)
        return [self._run]

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


def _sizes(role: str, scenario: Scenario) -> Mapping[Flow, int]:
    """Return the entries of the vectors that a machine sends, by flow."""
    if role == "netem":
        return {}
    sizes = {SENDS[role]: scenario.message_sizes.entries(SENDS[role])}
    return sizes | ({Flow.ACKNOWLEDGEMENT: 0} if role == "controller" else {})


def _start(generation: int, owned: Slice) -> Start:
    """Return the start of a process: for the controller, its first tick.

    If the controller died before its first tick, its first message determines the start.
    """
    if not generation or CONTROLLER_STEP not in owned:
        return Start(generation)
    steps, deliveries = owned[CONTROLLER_STEP], owned[CONTROLLER_DELIVERY]
    first_ns = (*steps["t_ns"][:1], *deliveries["model_t_ns"][:1])
    return Start(generation, int(min(first_ns, default=0)))

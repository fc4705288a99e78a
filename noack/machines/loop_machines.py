"""The machines of one role, of all loops of a run: the core's steps, and Python's part of them.

A driver in C (live, in virtual time, in replay) makes the steps. A step calls this class where it
needs Python: users' code, changes of settings. The driver returns when there are rows to take.

What a role describes of each machine is a *part*: it fills the core's structure, and answers the
questions of a step (``enum noack_question`` in native/loop/public.h).

The loops may have vectors of different sizes. The rows of a table then have room for the longest;
what a loop's own row lacks is missing in them (:func:`row_layout`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cache, lru_cache
from typing import NamedTuple, NoReturn, TypeVar
from weakref import proxy

import numpy as np
from numpy.typing import NDArray

from noack.core.clock import NEVER_NS
from noack.core.core_library import CData, CoreMemory, StructRows, core, dtype_of, ffi, pointer_to
from noack.core.errors import CallerError
from noack.core.periods import NO_PERIOD, Period
from noack.protocol.record_tables import LOOP, RecordShape, largest, tables
from noack.protocol.roles import External, Notice, Record
from noack.protocol.wire_format import Flow
from noack.scenario.parameter_changes import AppliedParameters, ChangeSchedule, ParameterChange, settings_key
from noack.scenario.scenario import Scenario

NewRows = Callable[[int, "np.dtype[np.void]"], StructRows]
"""Returns memory for a number of rows of a type."""
_ROWS, _ROWS_OF_A_LOOP, _MOST_ROWS = 1024, 256, 16_384
"""Rows of each table: at least, for each loop, and at most for all loops."""
_NOTES = 256
"""Notes for which there is room until rows are taken."""


class Role(NamedTuple):
    """What the machines of a process have in common."""

    name: str
    structure: str
    """Name of the core's structure of one machine, and of the field of ``noack_process``."""
    receives: Flow
    tables: tuple[str | None, str | None, str | None]
    """The record's tables of ticks, messages and acknowledgements."""
    changes: str | None = None
    """The table of announced changes of settings; None: none can be announced."""

    @property
    def number(self) -> int:
        """The role's number in the core."""
        return int(getattr(core, f"NOACK_{self.name.upper()}"))


class MachinePart(ABC):
    """The description of one loop's machine, and what only Python can do for it."""

    role: Role
    schedule: ChangeSchedule[object] | None = None
    """The announced changes of its settings; None if they cannot change."""

    @property
    def counts_every_message(self) -> bool:
        """Whether :meth:`inspect` needs all rows, not only those of messages after losses."""
        return False

    @property
    @abstractmethod
    def shape(self) -> RecordShape:
        """The sizes of the rows that it writes."""

    @property
    def external(self) -> External | None:
        """What another program has of it."""
        return None

    @abstractmethod
    def fill(self, structure: CData, memory: CoreMemory) -> None:
        """Fill the core's structure, at the start of the machine's work."""

    @abstractmethod
    def set_drawn_values(self, structure: CData, memory: CoreMemory) -> None:
        """Set what the draws determine, in a copy of another loop's structure."""

    @abstractmethod
    def answer(self, question: int, structure: CData) -> Sequence[Notice]:
        """Do what a step needs before it goes on; return lines for the log."""

    def inspect(self, rows: StructRows) -> Sequence[Notice]:
        """Return lines for the log about new rows of received messages."""
        return ()

    def note(self, note: CData) -> Notice:
        """Return the line for the log that a step has asked for by a ``noack_note``."""
        raise ValueError(f"a {self.role.name} writes no notes")


Prepared = TypeVar("Prepared")
Part = TypeVar("Part", bound=MachinePart)


def parts_of(
    loops: Sequence[Scenario], part: Callable[[Scenario], Part], with_draws: Callable[[Part, Scenario], Part]
) -> tuple[list[Part], list[int]]:
    """Return each loop's part, and the first loop from which it differs in draws only.

    ``part`` makes the part of such a first loop; ``with_draws`` makes those of the others of it.
    """
    firsts: dict[tuple[int, ...], int] = {}
    templates = [firsts.setdefault(settings_key(loop), number) for number, loop in enumerate(loops)]
    parts: list[Part] = []
    for number, (loop, first) in enumerate(zip(loops, templates, strict=True)):
        parts.append(part(loop) if number == first else with_draws(parts[first], loop))
    return parts, templates


def set_machine(
    machine: CData,
    *,
    n: int,
    m: int,
    entries: int,
    flow: Flow,
    period: Period | None = None,
    horizon_ns: int,
) -> None:
    """Fill a new ``noack_machine``; its ticks begin at time 0."""
    machine.n, machine.m = n, m
    machine.period, machine.horizon_ns = NO_PERIOD if period is None else period.core, horizon_ns
    machine.reached_ns, machine.change_ns = -1, NEVER_NS
    machine.received.flow, machine.received.entries = flow, entries
    machine.acknowledgements.flow = Flow.ACKNOWLEDGEMENT
    for reception in (machine.received, machine.acknowledgements):
        reception.newest, reception.not_after_ns = -1, horizon_ns


def take_changes(
    schedule: ChangeSchedule[Prepared] | None, machine: CData
) -> Sequence[AppliedParameters[Prepared]]:
    """Return the changes that are due at the time at which a step asked, in order."""
    assert schedule is not None
    due = schedule.take(machine.change_ns)
    machine.change_ns = schedule.next_ns
    return due


class LoopMachines:
    """The machines of a role.

    Args:
        parts: the machine of each loop.
        phases_ns: when each loop begins, in the run's time; by default 0.
        templates: the loop whose structure each loop's is a copy of, since they differ in draws
            only; by default its own.
        rows: rows of each table until they must be taken; by default as many as suit the loops.

    Raises:
        ValueError: the core refuses a machine's numbers.
    """

    def __init__(
        self,
        parts: Sequence[MachinePart],
        phases_ns: Sequence[int] | None = None,
        *,
        templates: Sequence[int] | None = None,
        rows: int | None = None,
    ) -> None:
        self.parts = tuple(parts)
        self.role = self.parts[0].role
        self.phases_ns = tuple(phases_ns or (0,) * len(self.parts))
        self.memory = CoreMemory()
        """What the structures refer to."""
        self._notices: list[Notice] = []
        self._failure: BaseException | None = None
        self.before_answer: Callable[[MachinePart], None] | None = None
        """Called before a part answers a question."""
        self.core: CData = self.memory.keep(ffi.new("noack_process *"))
        """The ``noack_process``; its address does not change."""
        self._fill_machines(templates or range(len(self.parts)))
        self._inspected_loops = {k for k, part in enumerate(self.parts) if part.counts_every_message}
        """Loops of which every message may matter."""
        self._message = ffi.new("noack_message *")
        self._notes = np.zeros(_NOTES, dtype_of("noack_note"))
        self._tables: dict[int, StructRows] = {}
        self._new_rows: NewRows = np.empty
        most = min(_ROWS_OF_A_LOOP * len(self.parts), _MOST_ROWS)
        self._fill_tables(rows or max(_ROWS, most))
        wrong = core.noack_process_check(self.core)
        if wrong != ffi.NULL:
            raise ValueError(f"{self.role.name}: {ffi.string(wrong).decode()}")
        core.noack_process_begin(self.core)

    def _fill_machines(self, templates: Sequence[int]) -> None:
        process, count, keep = self.core, len(self.parts), self.memory.keep
        process.role, process.loops = self.role.number, count
        machines = keep(ffi.new(f"{self.role.structure}[]", count))
        setattr(process, f"{self.role.name}s", machines)
        process.heap = keep(ffi.new("noack_heap_entry[]", count))
        self.machines: CData = machines
        """(loops,) The structures of the machines."""
        copies: dict[int, list[int]] = {}
        for number, first in enumerate(templates):
            copies.setdefault(first, []).append(number)
        for first, (_, *others) in copies.items():
            mark = self.memory.mark
            self.parts[first].fill(machines[first], self.memory)
            if others:
                self.memory.copy(machines, first, others, mark)
            for number in others:
                if self.parts[number] is not self.parts[first]:
                    self.parts[number].set_drawn_values(machines[number], self.memory)
        this = proxy(self)  # what the core calls must not keep these machines alive
        ask = keep(ffi.callback(
            "int64_t(int64_t, int64_t)", lambda *asked: this._answer(*asked), error=1,
            onerror=lambda *failed: this._keep_failure(*failed),
        ))  # fmt: skip
        for loop, (structure, phase_ns) in enumerate(zip(machines, self.phases_ns, strict=True)):
            structure.machine.phase_ns, structure.machine.loop, structure.machine.ask = phase_ns, loop, ask

    def _fill_tables(self, rows: int) -> None:
        self.core.notes = pointer_to(self._notes, "noack_note *")
        self.core.note_places = len(self._notes)
        shapes = [part.shape for part in self.parts]
        types = row_types(shapes)
        for number, name in enumerate(self.role.tables):
            if name is None or name not in types:
                continue
            table = self.core.tables[number]
            table.row_bytes, table.places = types[name].itemsize, rows
            self._renew_table(number, np.empty(rows, types[name]))
            if len(set(shapes)) > 1:
                table.layouts = self._layouts(name, types[name], shapes)

    def _layouts(self, name: str, table_type: np.dtype[np.void], shapes: Sequence[RecordShape]) -> CData:
        """Return the layout of each loop's rows in a table; loops of a shape share it."""

        @cache
        def layout(shape: RecordShape) -> CData:
            loop_type = tables(**asdict(shape)).get(name)
            return ffi.NULL if loop_type is None else self.memory.integers(row_layout(loop_type, table_type))

        return self.memory.keep(ffi.new("int64_t *[]", [layout(shape) for shape in shapes]))

    def take_rows_from(self, new_rows: NewRows) -> None:
        """Let ``new_rows`` provide the memory of the rows, from before the first step on."""
        self._new_rows = new_rows
        for number, rows in self._tables.items():
            self._renew_table(number, new_rows(len(rows), rows.dtype))

    def _renew_table(self, number: int, rows: StructRows) -> None:
        self._tables[number] = rows
        self.core.tables[number].rows = pointer_to(rows, "uint8_t *")

    def next_deadline_ns(self) -> int | None:
        """The earliest tick of all loops, in the run's time."""
        due_ns = int(core.noack_process_due_ns(self.core))
        return None if due_ns == NEVER_NS else due_ns

    def connect(self) -> None:
        """Connect with the programs that have a part of a machine, before a live run.

        Raise CallerError if that fails.
        """
        for part in self.parts:
            if part.external is not None:
                part.external.connect()

    def raise_failure(self) -> NoReturn:
        """Raise the exception of the answer for lack of which a step was not done."""
        failure, self._failure = self._failure, None
        assert failure is not None
        raise failure

    def _answer(self, loop: int, question: int) -> int:
        """Do what a step needs before it goes on; the core calls this. Return 0."""
        self.core.has_asked = 1
        if self.before_answer is not None:
            self.before_answer(self.parts[loop])
        self._keep_notices(loop, self.parts[loop].answer(question, self.machines[loop]))
        self._update_counting(loop)
        return 0

    def _keep_failure(self, _: object, failure: BaseException, __: object) -> None:
        self._failure = failure

    def take_rows(self, *, last: bool = False) -> list[tuple[str, StructRows]]:
        """Return the rows since the last call, by table, and empty the core's tables.

        ``last``: the machines make no step before the caller has used the rows, which the next step
        overwrites.
        """
        batches: list[tuple[str, StructRows]] = []
        for number, rows in self._tables.items():
            table = self.core.tables[number]
            if table.count:
                new, table.count = rows[: table.count], 0
                if not last and 2 * len(new) < len(rows):
                    new = new.copy()
                elif not last:
                    self._renew_table(number, self._new_rows(len(rows), rows.dtype))
                name = self.role.tables[number]
                assert name is not None
                batches.append((name, new))
                if number == core.NOACK_MESSAGES:
                    self._inspect(new)
        for note in self._notes[: self.core.note_count]:
            loop = int(note["loop"])
            self._keep_notices(loop, (self.parts[loop].note(note),))
        self.core.note_count = 0
        return batches

    def take_notices(self) -> list[Notice]:
        """Return the lines for the log since the last call; call :meth:`take_rows` before."""
        notices, self._notices = self._notices, []
        return notices

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Announce a change of settings to every machine; its time is that of the run.

        Raise CallerError, and change nothing, if these machines' settings cannot change, or if a
        loop's scenario would be invalid.
        """
        table, schedules = self.role.changes, [part.schedule for part in self.parts]
        loop_changes = [change._replace(t_ns=max(change.t_ns - ns, 0)) for ns in self.phases_ns]
        for schedule, loop_change, structure in zip(schedules, loop_changes, self.machines, strict=True):
            if table is None or schedule is None:
                raise CallerError(f"the settings of this {self.role.name} cannot be changed")
            schedule.check(loop_change, structure.machine.reached_ns)
        outputs: list[Record | Notice] = []
        for loop, schedule in enumerate(schedules):
            assert table is not None
            assert schedule is not None
            machine = self.machines[loop].machine
            announced = schedule.announce(
                table, loop_changes[loop], machine.inputs, now_ns - self.phases_ns[loop], machine.reached_ns
            )
            machine.inputs += 1
            machine.change_ns = schedule.next_ns
            outputs += [_with_loop(loop, output) for output in announced]
            self._update_counting(loop)
        return outputs

    def _inspect(self, rows: StructRows) -> None:
        notable = self._notable(rows)
        if not len(notable):
            return
        for loop_rows in np.split(notable, np.flatnonzero(np.diff(notable[LOOP])) + 1):
            loop = int(loop_rows[LOOP][0])
            self._keep_notices(loop, self.parts[loop].inspect(loop_rows))
            self._update_counting(loop)

    def _update_counting(self, loop: int) -> None:
        if self.parts[loop].counts_every_message:
            self._inspected_loops.add(loop)
        else:
            self._inspected_loops.discard(loop)

    def _notable(self, rows: StructRows) -> StructRows:
        """Return the rows that a part may have to say something about."""
        notable = np.zeros(len(rows), np.bool_)
        if self._inspected_loops:
            notable |= np.isin(rows[LOOP], sorted(self._inspected_loops))
        if "dropouts" in (rows.dtype.names or ()):
            notable |= rows["dropouts"] > 0
        return rows[notable]

    def _keep_notices(self, loop: int, notices: Sequence[Notice]) -> None:
        self._notices += [notice._replace(loop=loop) for notice in notices]


def _with_loop(loop: int, output: Record | Notice) -> Record | Notice:
    """Return an output of a loop's machine with the number of the loop."""
    if isinstance(output, Record):
        return Record(output.table, (loop, *output.row))
    return output._replace(loop=loop)


def row_types(shapes: Iterable[RecordShape]) -> Mapping[str, np.dtype[np.void]]:
    """Return the row types of the tables of loops; a row begins with the number of its loop."""
    return _row_types(largest(set(shapes)))


@lru_cache
def _row_types(shape: RecordShape) -> Mapping[str, np.dtype[np.void]]:
    types = tables(**asdict(shape))
    return {name: np.dtype([(LOOP, "<u2"), *kind.descr]) for name, kind in types.items()}


def row_layout(loop_type: np.dtype[np.void], table_type: np.dtype[np.void]) -> NDArray[np.int64]:
    """Return which word of a loop's own row each word of a table's row is.

    A vector of the loop is the beginning of the table's; the rest of it is NaN. A column that the
    loop does not have is 0.

    Args:
        loop_type: the row type of the loop, without its number.
        table_type: the row type of the table, with the number of the loop.
    """
    layout = np.full((table_type.itemsize - core.NOACK_LOOP_BYTES) // 8, core.NOACK_MISSING_ZERO)
    for name in loop_type.names or ():
        assert loop_type.fields is not None
        assert table_type.fields is not None
        (kind, begin), (table_kind, table_begin) = loop_type.fields[name][:2], table_type.fields[name][:2]
        first, words = (table_begin - core.NOACK_LOOP_BYTES) // 8, kind.itemsize // 8
        layout[first : first + table_kind.itemsize // 8] = core.NOACK_MISSING_NAN
        layout[first : first + words] = begin // 8 + np.arange(words)
    return layout

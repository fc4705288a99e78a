"""The machines of one role, of all loops of a run: the core's steps, and Python's part of them.

A driver in C (live, in virtual time, in replay) makes the steps. A step calls this class where it
needs Python: users' code, changes of settings. The driver returns when there are rows to take.

What a role describes of each machine is a *part*: it gives the machine's settings, and answers the
questions of a step (``enum noack_question`` in native/loop/public.h).

The loops may have vectors of different sizes. The rows of a table then have room for the longest;
what a loop's own row lacks is missing in them (:func:`row_layout`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import NamedTuple, NoReturn, TypeVar
from weakref import proxy

import numpy as np
from numpy.typing import NDArray

from netem.core.clock import NEVER_NS
from netem.core.core_library import CData, Reals, StructRows, rows_at, set_fields
from netem.core.errors import CallerError
from noack.core.core_library import core, ffi, new_handle, new_structure, pointer_to
from noack.protocol.record_tables import LOOP, RecordShape, largest, tables
from noack.protocol.roles import External, Notice, Record
from noack.protocol.wire_format import Flow
from noack.scenario.parameter_changes import AppliedParameters, ChangeSchedule, ParameterChange, settings_key
from noack.scenario.scenario import Scenario

NewRows = Callable[[int, "np.dtype[np.void]"], StructRows]
"""Returns memory for a number of rows of a type."""
_ROWS, _ROWS_OF_A_LOOP, _MOST_ROWS = 1024, 256, 16_384
"""Rows of each table: at least, for each loop, and at most for all loops."""


class Role(NamedTuple):
    """What the machines of a process have in common."""

    name: str
    """What it is, and the core's ``noack_NAME``."""
    receives: Flow
    tables: tuple[str | None, str | None, str | None]
    """The record's tables of ticks, messages and acknowledgements."""
    changes: str | None = None
    """The table of announced changes of settings; None: none can be announced."""

    @property
    def number(self) -> int:
        """The role's number in the core."""
        return int(getattr(core, f"NOACK_{self.name.upper()}"))


class TransitionMatrices:
    """The models of the machines of a process; loops with the same H share their matrices."""

    def __init__(self) -> None:
        self._shared: dict[bytes, CData] = {}

    def of(self, H: Reals, steps_ns: Iterable[int] = ()) -> CData:
        """Return the ``noack_transitions *`` of H, (n, n), which lives as long as this object.

        The matrices of ``steps_ns`` are computed at once, so that first deadlines are not delayed.
        """
        H = np.array(H, np.float64, order="C")
        key = H.tobytes()
        if key not in self._shared:
            self._shared[key] = new_handle("transitions", len(H), pointer_to(H, "double *"))
        for step_ns in steps_ns if H.any() else ():
            if step_ns > 0:
                core.noack_transition(self._shared[key], step_ns)
        return self._shared[key]


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
    def settings(self, models: TransitionMatrices) -> Mapping[str, object]:
        """Return the fields of the core's structure that are not 0, without the drawn ones."""

    @abstractmethod
    def drawn_settings(self) -> Mapping[str, object]:
        """Return the fields that the draws determine; loops may differ in them alone."""

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
        self._models = TransitionMatrices()
        self._notices: list[Notice] = []
        self._failure: BaseException | None = None
        self.before_answer: Callable[[MachinePart], None] | None = None
        """Called before a part answers a question."""
        self.machines = self._new_machines(templates or range(len(self.parts)))
        """The ``noack_plant``, ``noack_sensor`` or ``noack_controller`` of each loop."""
        self._inspected_loops = {k for k, part in enumerate(self.parts) if part.counts_every_message}
        """Loops of which every message may matter."""
        self._tables: dict[int, StructRows] = {}
        self._new_rows: NewRows = np.empty
        this = proxy(self)  # what the core calls must not keep these machines alive
        self._ask = ffi.callback(
            "int64_t(int64_t, int64_t)", lambda *asked: this._answer(*asked), error=1,
            onerror=lambda *failed: this._keep_failure(*failed),
        )  # fmt: skip
        most = min(_ROWS_OF_A_LOOP * len(self.parts), _MOST_ROWS)
        self.core: CData = self._new_process(rows or max(_ROWS, most))
        """The ``noack_process``."""

    def _new_machines(self, templates: Sequence[int]) -> list[CData]:
        kind, machines = f"noack_{self.role.name}", list[CData]()
        for loop, (part, first) in enumerate(zip(self.parts, templates, strict=True)):
            if loop == first:
                settings = new_structure(kind, part.settings(self._models))
            else:
                settings = ffi.new(f"{kind} *", machines[first][0])
            if loop == first or part is not self.parts[first]:
                set_fields(settings, part.drawn_settings())
            settings.machine.phase_ns = self.phases_ns[loop]
            machines.append(new_handle(self.role.name, settings))
        return machines

    def _new_process(self, rows: int) -> CData:
        shapes = [part.shape for part in self.parts]
        types = row_types(shapes)
        kinds = {shape: number for number, shape in enumerate(dict.fromkeys(shapes))}
        kind_of = np.array([kinds[shape] for shape in shapes])
        given, layouts = ffi.new("noack_table[]", core.NOACK_TABLES), list[NDArray[np.int64]]()
        for number, name in enumerate(self.role.tables):
            if name is None or name not in types:
                continue
            table, of_table = given[number], types[name]
            self._tables[number] = np.empty(rows, of_table)
            table.rows = pointer_to(self._tables[number], "uint8_t *")
            table.row_bytes, table.places = of_table.itemsize, rows
            if len(kinds) > 1:
                rows_of = [tables(**asdict(kind)).get(name) for kind in kinds]
                layouts.append(np.array([row_layout(own, of_table) for own in rows_of]))
                table.kinds, table.layouts = len(kinds), pointer_to(layouts[-1], "int64_t *")
                table.kind_of = pointer_to(kind_of, "int64_t *")
        machines = ffi.new("noack_machine *[]", [ffi.addressof(own.machine) for own in self.machines])
        return new_handle("process", self.role.number, len(machines), machines, self._ask, given)

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
        """Raise the exception of the answer for lack of which a step was not done, or MemoryError."""
        failure, self._failure = self._failure, None
        raise failure or MemoryError

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
        for note in rows_at(self.core.notes, self.core.note_count):
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


def row_layout(loop_type: np.dtype[np.void] | None, table_type: np.dtype[np.void]) -> NDArray[np.int64]:
    """Return which word of a loop's own row each word of a table's row is.

    A vector of the loop is the beginning of the table's; the rest of it is NaN. A column that the
    loop does not have is 0.

    Args:
        loop_type: the row type of the loop, without its number; None: it has no such table.
        table_type: the row type of the table, with the number of the loop.
    """
    layout = np.full((table_type.itemsize - core.NOACK_LOOP_BYTES) // 8, core.NOACK_MISSING_ZERO)
    for name in () if loop_type is None else loop_type.names or ():
        assert loop_type is not None
        assert loop_type.fields is not None
        assert table_type.fields is not None
        (kind, begin), (table_kind, table_begin) = loop_type.fields[name][:2], table_type.fields[name][:2]
        first, words = (table_begin - core.NOACK_LOOP_BYTES) // 8, kind.itemsize // 8
        layout[first : first + table_kind.itemsize // 8] = core.NOACK_MISSING_NAN
        layout[first : first + words] = begin // 8 + np.arange(words)
    return layout

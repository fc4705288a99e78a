"""The machines of one role, of all loops of a run: the core's steps, and Python's part of them.

A driver in C (live, in virtual time, in replay) makes the steps. It returns to this class where a
step needs Python: users' code, changes of settings, rows to take. One input at a time goes through
:meth:`LoopMachines.handle` and :meth:`LoopMachines.on_timer`, which make the same steps.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noack.config.parameter_changes import ParameterChange
from noack.core.core_library import core, dtype_of, ffi, pointer_to
from noack.core.core_memory import CoreMemory
from noack.core.errors import CallerError
from noack.machines.machine_parts import NEVER_NS, MachinePart, next_change_ns
from noack.protocol.machine_interface import Notice, Output, Record
from noack.protocol.record_tables import LOOP, RecordShape, tables
from noack.protocol.wire_format import Flow, Message

Rows = NDArray[np.void]

_ROWS, _ROWS_OF_A_LOOP, _MOST_ROWS = 1024, 256, 16_384
_NOTES = 256


class LoopMachines:
    """The machines of a role.

    Args:
        parts: the machine of each loop.
        phases_ns: when each loop begins, in the run's time; by default 0.
        alike: the number of the first loop, for each loop, from which it differs in draws only; by
            default its own.
        numbered: whether rows begin with the number of their loop.
        rows: rows of each table until they must be taken; by default as many as suit the loops.

    Raises:
        ValueError: the core refuses a machine's numbers, or the loops' rows differ.
    """

    def __init__(
        self,
        parts: Sequence[MachinePart],
        phases_ns: Sequence[int] | None = None,
        *,
        alike: Sequence[int] | None = None,
        numbered: bool = False,
        rows: int | None = None,
    ) -> None:
        self.parts = tuple(parts)
        self.role = self.parts[0].role
        if any(part.shape != self.parts[0].shape for part in self.parts):
            raise ValueError(f"the rows of these {self.role.name}s have different columns")
        self.phases_ns = tuple(phases_ns or (0,) * len(self.parts))
        self.numbered = numbered
        self._memory = CoreMemory()
        self._notices: list[Notice] = []
        self.core: Any = self._memory.keep(ffi.new("noack_process *"))
        """The ``noack_process``; its address does not change."""
        self._fill_machines(alike or range(len(self.parts)))
        self._message = ffi.new("noack_message *")
        self._notes = np.zeros(_NOTES, dtype_of("noack_note"))
        self._tables: dict[int, Rows] = {}
        most = min(_ROWS_OF_A_LOOP * len(self.parts), _MOST_ROWS)
        self._fill_tables(rows or max(_ROWS, most))
        wrong = core.noack_process_check(self.core)
        if wrong != ffi.NULL:
            raise ValueError(f"{self.role.name}: {ffi.string(wrong).decode()}")
        core.noack_process_begin(self.core)

    def _fill_machines(self, alike: Sequence[int]) -> None:
        process, count, keep = self.core, len(self.parts), self._memory.keep
        process.role, process.loops = self.role.number, count
        machines = keep(ffi.new(f"{self.role.structure}[]", count))
        setattr(process, f"{self.role.name}s", machines)
        process.due_ns = keep(ffi.new("int64_t[]", count))
        process.heap = keep(ffi.new("int64_t[]", count))
        self.machines: Any = machines
        """(loops,) The structures of the machines."""
        copies: dict[int, list[int]] = {}
        for number, first in enumerate(alike):
            copies.setdefault(first, []).append(number)
        for first, (_, *others) in copies.items():
            mark = self._memory.size
            self.parts[first].fill(machines[first], self._memory)
            if others:
                self._memory.copy(machines, first, others, mark)
            for number in others:
                self.parts[number].redraw(machines[number], self._memory)
        for structure, phase_ns in zip(machines, self.phases_ns, strict=True):
            structure.machine.phase_ns = phase_ns

    def _fill_tables(self, rows: int) -> None:
        self.core.notes = pointer_to(self._notes, "noack_note *")
        self.core.note_places = len(self._notes)
        types = row_types(self.parts[0].shape, numbered=self.numbered)
        for number, name in enumerate(self.role.tables):
            if name is None or name not in types:
                continue
            self._tables[number] = np.zeros(rows, types[name])
            table = self.core.tables[number]
            table.prefix_bytes = 2 * self.numbered
            table.row_bytes, table.places = types[name].itemsize, rows
            table.rows = pointer_to(self._tables[number], "uint8_t *")

    def next_deadline_ns(self) -> int | None:
        """The earliest tick of all loops, in the run's time."""
        due_ns = int(core.noack_process_due_ns(self.core))
        return None if due_ns == NEVER_NS else due_ns

    def answer(self, question: int) -> None:
        """Do what a step needs before it goes on."""
        loop = self.core.asking
        self._keep_notices(loop, self.parts[loop].answer(question, self.machines[loop]))

    def take_rows(self, *, last: bool = False) -> list[tuple[str, Rows]]:
        """Return the rows since the last call, by table, and empty the core's tables.

        ``last``: the machines make no more steps.
        """
        taken: list[tuple[str, Rows]] = []
        for number, rows in self._tables.items():
            table = self.core.tables[number]
            if table.count:
                found, table.count = rows[: table.count], 0
                if not last and 2 * len(found) < len(rows):
                    found = found.copy()
                elif not last:
                    self._tables[number] = np.empty(len(rows), rows.dtype)
                    table.rows = pointer_to(self._tables[number], "uint8_t *")
                name = self.role.tables[number]
                assert name is not None
                taken.append((name, found))
                if number == core.NOACK_MESSAGES:
                    self._inspect(found)
        for note in self._notes[: self.core.note_count]:
            loop = int(note["loop"])
            notice = self.parts[loop].note(self.machines[loop], note)
            self._keep_notices(loop, (notice,))
        self.core.note_count = 0
        return taken

    def take_notices(self) -> list[Notice]:
        """Return the lines for the log since the last call; call :meth:`take_rows` before."""
        taken, self._notices = self._notices, []
        return taken

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Announce a change of settings to every machine; its time is that of the run.

        Raise CallerError, and change nothing, if these machines' settings cannot change.
        """
        table = self.role.changes
        if table is None or any(part.schedule is None for part in self.parts):
            raise CallerError(f"the settings of this {self.role.name} cannot be changed")
        outputs: list[Record | Notice] = []
        for loop, (part, phase_ns) in enumerate(zip(self.parts, self.phases_ns, strict=True)):
            machine = self.machines[loop].machine
            own = change._replace(t_ns=max(change.t_ns - phase_ns, 0))
            assert part.schedule is not None
            announced = part.schedule.announce(
                table, own, machine.inputs, now_ns - phase_ns, machine.reached_ns
            )
            machine.inputs += 1
            machine.change_ns = next_change_ns(part.schedule)
            outputs += [self._of_loop(loop, output) for output in announced]
        return outputs

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process a message that arrives at ``now_ns``; return what the machine does.

        Raises:
            ValueError: the loop's machine does not receive such messages.
        """
        part, machine = self.parts[message.loop], self.machines[message.loop].machine
        receptions = [machine.received]
        if part.shape.acknowledged:
            receptions.append(machine.acknowledgements)
        entries = {reception.flow: reception.entries for reception in receptions}
        if entries.get(message.flow) != len(message.vector):
            raise ValueError(
                f"this {self.role.name} receives no {message.flow.name.lower()} "
                f"of {len(message.vector)} entries"
            )
        given, self._message.loop = self._message, message.loop
        given.flow, given.sequence, given.t_ns = message.flow, message.sequence, message.t_ns
        given.entries = len(message.vector)
        given.vector[0 : given.entries] = message.vector.tolist()
        return self._outputs(
            lambda: int(core.noack_process_handle(self.core, self._message, now_ns))
        )

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Do the one tick that is due; return what the machine does."""
        if self.next_deadline_ns() is None:
            return ()
        return self._outputs(lambda: int(core.noack_process_tick(self.core, now_ns)))

    def _outputs(self, step: Any) -> Sequence[Output]:
        outputs: list[Output] = []
        while (question := step()) != core.NOACK_DONE:
            if question != core.NOACK_ROWS_FULL:
                self.answer(question)
            outputs += self._taken()
        if self.core.output.sends:
            outputs.insert(0, message_of(self.core.output.message))
        outputs += self._taken()
        return outputs

    def _taken(self) -> list[Output]:
        records = [Record(table, rows[k].item()) for table, rows in self.take_rows()
                   for k in range(len(rows))]  # fmt: skip
        return [*records, *self.take_notices()]

    def _inspect(self, rows: Rows) -> None:
        if len(self.parts) == 1:
            self._keep_notices(0, self.parts[0].inspect(rows))
            return
        for row in self._notable(rows):
            loop = int(row[LOOP])
            self._keep_notices(loop, self.parts[loop].inspect(row[None]))

    def _notable(self, rows: Rows) -> Rows:
        """Return the rows that a part may have to say something about."""
        always = [loop for loop, part in enumerate(self.parts) if part.counts_every_message]
        notable = np.isin(rows[LOOP], always)
        if "dropouts" in (rows.dtype.names or ()):
            notable |= rows["dropouts"] > 0
        return rows[notable]

    def _keep_notices(self, loop: int, notices: Sequence[Notice]) -> None:
        self._notices += [self._of_loop(loop, notice) for notice in notices]

    def _of_loop(self, loop: int, output: Any) -> Any:
        """Return an output of a loop's machine with the number of the loop."""
        if not self.numbered:
            return output
        if isinstance(output, Record):
            return Record(output.table, (loop, *output.row))
        return output._replace(loop=loop)


def message_of(given: Any) -> Message:
    """Return a ``noack_message`` as a message."""
    data = ffi.buffer(given.vector, 8 * given.entries)
    vector = np.frombuffer(bytes(data), np.float64)
    return Message(Flow(given.flow), given.sequence, given.t_ns, vector, given.loop)


def row_types(shape: RecordShape, *, numbered: bool) -> Mapping[str, np.dtype[np.void]]:
    """Return the row types of the tables; ``numbered``: with the number of the loop in front."""
    sizes = vars(shape)
    types = tables(sizes["n"], sizes["m"], **{k: v for k, v in sizes.items() if k not in "nm"})
    if not numbered:
        return types
    return {name: np.dtype([(LOOP, "<u2"), *kind.descr]) for name, kind in types.items()}

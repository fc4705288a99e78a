"""Feeds a single machine its recorded inputs, and compares the rows that it emits."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cosim.analysis.replay.recorded_inputs import inputs_of
from cosim.analysis.replay.replay_result import difference, rows_differ
from cosim.analysis.summary_model import ReplayDifference
from cosim.record.record_source import Slice
from cosim.record.run_record import Rows
from noack.config.parameter_changes import ParameterChange
from noack.core.errors import CallerError
from noack.protocol.machine_interface import Machine, Notice, Record
from noack.runtime.fleet.fleet_replay import Numbers

_NOT_SENT = (Record, Notice)
_ANSWER_RANK, _LAST_RANK = 2, 3  # of several differences at one input, the first counts
_DAMAGE = (ArithmeticError, LookupError, ValueError, CallerError)
"""Errors of a machine that gets an input from a damaged record, which no run can have."""


class SingleMachineReplay:
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
        messages = [*itertools.chain(*itertools.starmap(inputs_of, self._owned.items()))]
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
        return table_and_row(self._owned, self._order[place])

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


def table_and_row(owned: Slice, place: int) -> tuple[str, int]:
    """Return table and row of a place among the rows of all tables."""
    for table, rows in owned.items():
        if place < len(rows):
            return table, place
        place -= len(rows)
    raise IndexError("the tables have fewer rows")


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

"""Like loops of a run in one line: one array operation does for all what it does for one.

The rows of the loops follow each other. Where an operation searches, sorts or accumulates numbers
or times, those of loop i are i · ``SPAN`` larger, so that the loops do not meet. Each result is
bit by bit that of the loop alone.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_record import RunRecord
from noack.core.cached_method import cached_method
from noack.protocol.machine_interface import RESTART
from noack.protocol.record_tables import SETTINGS
from noack.scenario.parameter_changes import settings_key

SPAN = 2**56
"""More than the numbers of inputs and messages, and the times in ns, of a loop."""
_LINE_ROWS = 2**16
"""Rows of a line's largest table: more would leave the processor's cache."""
Columns = Mapping[str, NDArray[Any]]
Numbers = NDArray[np.int64]


class LoopLine:
    """Short loops of one kind, none of which was restarted or changed.

    Args:
        records: the records of the loops, in memory.
    """

    def __init__(self, records: Sequence[RunRecord]) -> None:
        self.records = records
        self.scenario, self.loop = records[0].scenario, records[0].loop
        """Those of the first loop; the others differ in their plants."""

    @cached_method
    def starts(self, table: str) -> Numbers:
        """Return where the rows of each loop begin in a table, and their number, (loops + 1,)."""
        return np.cumsum([0, *(record.count(table) for record in self.records)])

    @cached_method
    def shifts(self, table: str) -> Numbers:
        """Return what the numbers of each row of a table are increased by."""
        return np.repeat(np.arange(len(self.records)) * SPAN, np.diff(self.starts(table)))

    @cached_method
    def column(self, table: str, name: str) -> NDArray[Any]:
        """Return a column of a table."""
        return np.concatenate([record[table][name] for record in self.records])

    def columns(self, table: str, *names: str) -> Columns:
        """Return some columns of a table."""
        return {name: self.column(table, name) for name in names}

    @cached_method
    def numbers(self, table: str, name: str) -> Numbers:
        """Return a column of numbers or times, increased.

        Raises:
            ValueError: it has values that no run has.
        """
        values = self.column(table, name)
        if ((values < -1) | (values >= SPAN)).any():
            raise ValueError(f"{table}: no run has this {name}")
        return np.asarray(values + self.shifts(table))

    def pieces(self, table: str) -> list[slice]:
        """Return where the rows of each loop are in a table."""
        return [slice(*ends) for ends in pairwise(self.starts(table).tolist())]


def lines_of(records: Sequence[RunRecord]) -> Iterator[LoopLine]:
    """Yield those of consecutive loops that can be in a line."""
    begun, kind, rows = list[RunRecord](), None, 0
    for record in records:
        of = _kind(record)
        if begun and (of != kind or rows >= _LINE_ROWS):
            yield LoopLine(begun)
            begun, rows = [], 0
        kind = of
        if kind is not None:
            begun.append(record)
            rows += max(map(record.count, record.tables))
    if begun:
        yield LoopLine(begun)


def _kind(record: RunRecord) -> object:
    """Return what the loops of a line have in common; None if a loop is in no line."""
    scenario = record.scenario
    restarted = any(one["level"] == RESTART for one in record.notices)
    if restarted or not record.is_short or any(record.count(one) for one in SETTINGS if one in record.tables):
        return None
    if scenario.trigger.weight is not None or any(scenario.controller.setpoint or ()):
        return None  # a matrix product for all loops may have other last bits
    return settings_key(scenario)

"""The generations of a process in a run: which of its rows are recorded, and when it was active."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.record_source import RecordSource, Rows, slices
from noack.protocol.machine_interface import GENERATION

_COLUMNS = ("input", "now_ns")


class RowCounts(NamedTuple):
    """The recorded rows of one generation of a process."""

    generation: int
    rows: Mapping[str, int]
    """Number of recorded rows by table."""
    report: Mapping[str, Any] | None


class Life(NamedTuple):
    """One generation of a process."""

    counts: RowCounts
    first_ns: int | None
    """Time of the first row; None without rows."""
    last_ns: int | None
    hole_ns: int | None
    """Time of the last input before a gap in the rows; None if there is no known gap. Rows that are
    missing at the end of a process without a report are unknown."""
    missing_inputs: int
    """Number of inputs without a row, before the last recorded input."""

    @property
    def generation(self) -> int:
        """Its number."""
        return self.counts.generation

    @property
    def rows(self) -> Mapping[str, int]:
        """Number of recorded rows by table."""
        return self.counts.rows

    @property
    def report(self) -> Mapping[str, Any] | None:
        """The final report; None if it wrote none."""
        return self.counts.report


class LifeNumbers(NamedTuple):
    """The numbers of the recorded generations of a process, ascending."""

    begun: Sequence[int]

    def places(self, rows: Rows) -> NDArray[np.intp]:
        """Return the place of each row's generation, (k,).

        A row with an unexpected number belongs to the generation before.
        """
        of = rows["input"] // GENERATION
        return (np.searchsorted(np.array(self.begun), of, side="right") - 1).clip(min=0)


def generations(source: RecordSource, tables: Sequence[str]) -> list[int]:
    """Return the generations of a role that wrote rows, from the number of each one's first input.

    If that row is missing, the rows of a later generation prove that there were earlier ones.
    """
    if all(source.highest_input(table) < GENERATION for table in tables):
        return [0]
    first, of = 0, np.zeros(0, np.int64)
    for table in tables:
        for rows in source.batches(table, ("input",)):
            inputs = rows["input"]
            begun = inputs[(inputs % GENERATION == 0) & (inputs > 0)] // GENERATION
            first = max(first, int(begun.max(initial=0)))
            of = np.union1d(of, inputs // GENERATION)
    return [0, *of[(of > 0) & (of <= first)].tolist()]


class _Counts:
    """Counts the rows of one generation, part by part."""

    def __init__(self, generation: int, tables: Sequence[str]) -> None:
        self.rows = dict.fromkeys(tables, 0)
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.hole_ns: int | None = None
        self._input, self._now_ns = generation * GENERATION - 1, 0
        self._numbers: dict[int, tuple[int, int]] = {}
        """By generation in the input numbers: the largest number, and the number of rows."""

    def add(self, part: Mapping[str, Rows]) -> None:
        """Add the rows of all tables up to the same time."""
        for table, rows in part.items():
            self.rows[table] += len(rows)
        inputs = np.concatenate([rows["input"] for rows in part.values()])
        now_ns = np.concatenate([rows["now_ns"] for rows in part.values()])
        if not len(inputs):
            return
        low_ns, high_ns = int(now_ns.min()), int(now_ns.max())
        self.first_ns = low_ns if self.first_ns is None else min(self.first_ns, low_ns)
        self.last_ns = high_ns if self.last_ns is None else max(self.last_ns, high_ns)
        order = np.argsort(inputs, kind="stable")
        inputs, now_ns = inputs[order], now_ns[order]
        holes = np.flatnonzero(np.diff(inputs, prepend=self._input) > 1)
        if len(holes) and self.hole_ns is None:
            before = (
                self._now_ns if holes[0] == 0 and self._numbers else now_ns[max(holes[0] - 1, 0)]
            )
            self.hole_ns = int(before)
        self._input, self._now_ns = int(inputs[-1]), int(now_ns[-1])
        first, last = (int(number) // GENERATION for number in (inputs[0], inputs[-1]))
        for of in [first] if first == last else np.unique(inputs // GENERATION).tolist():
            own = inputs if first == last else inputs[inputs // GENERATION == of]
            newest, count = self._numbers.get(of, (-1, 0))
            self._numbers[of] = max(newest, int(own[-1]) % GENERATION), count + len(own)

    @property
    def missing_inputs(self) -> int:
        return sum(newest + 1 - count for newest, count in self._numbers.values())


def lives_of(
    source: RecordSource,
    tables: Sequence[str],
    numbers: LifeNumbers,
    reports: Mapping[int, Mapping[str, Any]],
    width_ns: int,
) -> list[Life]:
    """Return the generations of one process from its tables; ``reports`` are by generation."""
    counts = [_Counts(generation, tables) for generation in numbers.begun]
    for part in slices(source, tables, width_ns, _COLUMNS):
        if len(counts) == 1:
            counts[0].add(part)
            continue
        places = {table: numbers.places(rows) for table, rows in part.items()}
        for i, count in enumerate(counts):
            count.add({table: rows.compress(places[table] == i) for table, rows in part.items()})
    return [
        Life(
            RowCounts(generation, one.rows, reports.get(generation)),
            one.first_ns, one.last_ns, one.hole_ns, one.missing_inputs,
        )
        for generation, one in zip(numbers.begun, counts, strict=True)
    ]  # fmt: skip

"""Tables of results, and their files: CSV for papers and spreadsheets.

A table is rows of text. Before it is written as CSV, the units of its values move to the heads.
"""

import csv
import io
import re
from collections.abc import Collection, Mapping, Sequence
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

from netem.core.number_format import NONE

KEY_VALUE = ("quantity", "value")
"""Headings of a table in which each row has its own unit."""
_WITH_UNIT = re.compile(r"([-−+]?\d[\d.,]*(?:e[-+]?\d+)?) (s|ms|µs|ns|%|/s|Hz|bytes)")


class Tone(StrEnum):
    """What a text means for the reader; each output has its own look for it."""

    GOOD = "good"
    DOUBTFUL = "doubt"
    BAD = "bad"
    NEUTRAL = ""
    QUIET = "quiet"


class ResultTable(NamedTuple):
    """A table of text."""

    name: str
    """Name of its files; empty: it has none."""
    caption: str
    headings: Sequence[str]
    """Empty for a list of words and what they are about."""
    rows: Sequence[Sequence[str]]
    names: int = 1
    """Number of first columns that name a row; the others have values."""
    left: Collection[int] | None = None
    """Columns that begin at the left on a terminal; by default those with names."""
    tones: Mapping[str, Tone] = MappingProxyType({})
    """Tones of texts in the last column (of a list: in the first), by their first words."""
    is_dense: bool = False
    """On a terminal: save width, break no words, and no lines at the right."""
    splits: bool = False
    """Whether a terminal shows a wide table in parts, without columns that have the same text everywhere."""
    shown: Collection[int] | None = None
    """Rows that a terminal shows; None: all."""
    more: str = ""
    """Line below the table on a terminal."""
    links: Mapping[str, str] = MappingProxyType({})
    """Addresses to which the names of rows lead on a page."""

    @property
    def left_columns(self) -> Collection[int]:
        """The columns that begin at the left."""
        return range(self.names) if self.left is None else self.left

    def tone_of(self, column: int, text: str) -> Tone:
        """Return the tone of a text in a column."""
        if column != (len(self.headings) - 1 if self.headings else 0):
            return Tone.NEUTRAL
        return next((tone for word, tone in self.tones.items() if text.startswith(word)), Tone.NEUTRAL)

    @property
    def rows_on_terminal(self) -> list[Sequence[str]]:
        """The rows that a terminal shows."""
        return [row for i, row in enumerate(self.rows) if self.shown is None or i in self.shown]


def as_csv(table: ResultTable) -> str:
    """Return a table as CSV with a line of headings; a minus is a hyphen, no value is empty."""
    table = _with_units_in_heads(table)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(" ".join(heading.split()) for heading in table.headings)
    for label, *cells in table.rows:
        values = ["" if cell in (NONE, "–") else cell.replace("−", "-") for cell in cells]
        writer.writerow([label.strip(), *values])
    return buffer.getvalue()


def _with_units_in_heads(table: ResultTable) -> ResultTable:
    """Move the units of values to the heads of their rows (of key numbers) or columns."""
    if tuple(table.headings) == KEY_VALUE:
        rows = []
        for label, value in table.rows:
            match = _WITH_UNIT.fullmatch(value)
            rows.append((f"{label} [{match[2]}]", match[1]) if match else (label, value))
        return table._replace(rows=rows)
    columns: list[list[str]] = []
    headings: list[str] = []
    for heading, *column in zip(table.headings, *table.rows, strict=True):
        matches = [_WITH_UNIT.fullmatch(cell) for cell in column]
        units = {match[2] for match in matches if match}
        pairs = list(zip(matches, column, strict=True))
        if len(units) == 1 and all(match or cell in (NONE, "") for match, cell in pairs):
            heading = f"{heading} [{units.pop()}]"
            column = [match[1] if match else cell for match, cell in pairs]
        headings.append(heading)
        columns.append(column)
    return table._replace(headings=headings, rows=list(zip(*columns, strict=True)))

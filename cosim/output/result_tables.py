"""Tables of results: for a terminal, and as CSV for papers and spreadsheets.

A table is rows of text. Before it is written as CSV, the units of its values move to the heads.
"""

import csv
import io
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import HEAVY_HEAD, SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cosim.record.run_directory import require_folder, write_output
from noack.core.number_format import NONE

KEY_VALUE = ("quantity", "value")
"""Headings of a table in which each row has its own unit."""
_WITH_UNIT = re.compile(r"([-−+]?\d[\d.,]*(?:e[-+]?\d+)?) (s|ms|µs|ns|%|/s|Hz|bytes)")


class ResultTable(NamedTuple):
    """A table of text."""

    name: str
    """Name of its files."""
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def terminal_table(
    table: ResultTable,
    *,
    left: Collection[int] = (0,),
    styles: Mapping[str, str] | None = None,
    dense: bool = False,
) -> Table:
    """Return a table for a terminal.

    Args:
        table: the table.
        left: numbers of the columns that begin at the left; the others end at the right.
        styles: styles of texts in the last column, by their first words.
        dense: save width, break no words, and no lines at the right.
    """
    rich_table = Table(
        title=escape(table.caption) if table.caption else None,
        box=SIMPLE_HEAD if dense else HEAVY_HEAD,
        collapse_padding=dense,
        pad_edge=not dense,
    )
    for i, heading in enumerate(table.headings):
        words = " ".join([heading, *(row[i] for row in table.rows)]).split()
        min_width = max(map(len, words)) if dense else None
        rich_table.add_column(escape(heading), justify="left" if i in left else "right", min_width=min_width)
        rich_table.columns[-1].no_wrap = dense and i not in left
    for *cells, last in table.rows:
        style = next((style for word, style in (styles or {}).items() if last.startswith(word)), "")
        rich_table.add_row(*map(escape, cells), Text(last, style))
    return rich_table


def save_tables(tables: Iterable[ResultTable], folder: Path) -> list[Path]:
    """Write tables into a folder, each as ``NAME.csv``.

    Returns:
        The written files.

    Raises:
        MachineError: a file cannot be written.
    """
    require_folder(folder)
    return [write_output(folder / f"{table.name}.csv", as_csv(table)) for table in tables]


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

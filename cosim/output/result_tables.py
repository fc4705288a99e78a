"""Tables of results as LaTeX (booktabs) and CSV, for papers and spreadsheets.

A table is the rows of text that noack prints. Before it is written, the units of its values move
to the heads.
"""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from cosim.output.latex_text import latex_text
from noack.core.file_access import write_whole
from noack.core.number_format import NONE

KEY_VALUE = ("quantity", "value")
"""Headings of a table in which each row has its own unit."""
_MEASURED = re.compile(r"([-−+]?\d[\d.,]*(?:e[-+]?\d+)?) (s|ms|µs|ns|%|/s|Hz|bytes)")
_NUMBER = re.compile(r"[-−]?\d+(?:\.(\d+))?")
_NUMERIC = re.compile(r"[-−+]?\d.*|void|never|\(same\)|[-–]")
_LINES = r"p{0.4\linewidth}"
"""Kind of a column with lines."""
_END = r" \tabularnewline"  # \raggedright changes \\
_BREAK = r" \\ "
_WIDE = 36
"""Characters from which on a column breaks its lines."""


class ResultTable(NamedTuple):
    """A table of text."""

    name: str
    """Name of its files."""
    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def save_tables(tables: Iterable[ResultTable], folder: Path) -> list[Path]:
    r"""Write tables into a folder, each as ``NAME.tex`` for LaTeX's \input and as ``NAME.csv``.

    Returns:
        The written files.

    Raises:
        MachineError: a file cannot be written.
    """
    return [
        write_whole(folder / f"{table.name}.{ending}", written)
        for table in tables
        for ending, written in (("tex", as_latex(table)), ("csv", as_csv(table)))
    ]


def as_latex(table: ResultTable) -> str:
    """Return a table as a ``tabular`` with the rules of booktabs; numbers are aligned."""
    table = _with_units_in_heads(table)
    columns = list(zip(*table.rows, strict=True)) or [()] * len(table.headings)
    kinds = [_kind(column, i) for i, column in enumerate(columns)]
    cells = [
        _aligned(column) if kind == "r" else [_words(cell, kind) for cell in column]
        for column, kind in zip(columns, kinds, strict=True)
    ]
    lines = [
        "% " + " ".join(table.caption.split()),
        r"% needs \usepackage{booktabs}",
        rf"\begin{{tabular}}{{@{{}}{''.join(kinds)}@{{}}}}",
        r"\toprule",
        " & ".join(_heading(*pair) for pair in zip(table.headings, kinds, strict=True)) + _END,
        r"\midrule",
        *(" & ".join(row) + _END for row in zip(*cells, strict=True)),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


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
            found = _MEASURED.fullmatch(value)
            rows.append((f"{label} [{found[2]}]", found[1]) if found else (label, value))
        return table._replace(rows=rows)
    columns: list[list[str]] = []
    headings: list[str] = []
    for heading, *column in zip(table.headings, *table.rows, strict=True):
        measured = [_MEASURED.fullmatch(cell) for cell in column]
        units = {one[2] for one in measured if one}
        pairs = list(zip(measured, column, strict=True))
        if len(units) == 1 and all(one or cell in (NONE, "") for one, cell in pairs):
            heading = f"{heading} [{units.pop()}]"
            column = [one[1] if one else cell for one, cell in pairs]
        headings.append(heading)
        columns.append(column)
    return table._replace(headings=headings, rows=list(zip(*columns, strict=True)))


def _kind(column: Sequence[str], place: int) -> str:
    """Return the kind of a column: numbers at the right, long texts in lines."""
    filled = [cell for cell in column if cell]
    if place and filled and 2 * sum(bool(_NUMERIC.fullmatch(one)) for one in filled) > len(filled):
        return "r"
    longest = max(map(len, column), default=0)
    return _LINES if longest > _WIDE and place else "l"


def _heading(heading: str, kind: str) -> str:
    lines = [latex_text(line) for line in heading.split("\n")]
    if len(lines) == 1:
        return lines[0]
    return rf"\begin{{tabular}}[b]{{@{{}}{kind[0]}@{{}}}}{_BREAK.join(lines)}\end{{tabular}}"


def _words(cell: str, kind: str) -> str:
    """Return a text; a row that explains the one above it is indented."""
    indent = r"\quad " if cell.startswith("  ") else ""
    if kind == _LINES:
        indent += r"\raggedright "
    return indent + latex_text(cell.strip())


def _aligned(column: Sequence[str]) -> list[str]:
    """Align decimal points by invisible digits; other cells stay at the right."""
    found = [_NUMBER.fullmatch(cell) for cell in column]
    decimals = [len(one[1] or "") for one in found if one]
    most = max(decimals, default=0)
    cells = []
    for cell, number in zip(column, found, strict=True):
        if number is None:
            cells.append("--" if cell == NONE else latex_text(cell))
            continue
        own = len(number[1] or "")
        missing = ("" if own else ".") + "0" * (most - own) if most > own else ""
        sign, digits = (r"\ensuremath{-}", cell[1:]) if cell[0] in "-−" else ("", cell)
        cells.append(sign + digits + (rf"\phantom{{{missing}}}" if missing else ""))
    return cells

"""Tables of results: for a terminal, as LaTeX (booktabs) for papers, as CSV for spreadsheets.

A table is rows of text. Before it is written as LaTeX or CSV, the units of its values move to the
heads. The texts compile with pdfLaTeX, too.
"""

import csv
import io
import re
import tomllib
import unicodedata
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import HEAVY_HEAD, SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from noack.core.file_access import write_whole
from noack.core.number_format import NONE

KEY_VALUE = ("quantity", "value")
"""Headings of a table in which each row has its own unit."""
_WITH_UNIT = re.compile(r"([-−+]?\d[\d.,]*(?:e[-+]?\d+)?) (s|ms|µs|ns|%|/s|Hz|bytes)")
_NUMBER = re.compile(r"[-−]?\d+(?:\.(\d+))?")
_NUMERIC = re.compile(r"[-−+]?\d.*|void|never|\(same\)|[-–]")
_LINES = r"p{0.4\linewidth}"
"""Kind of a column with lines."""
_END = r" \tabularnewline"  # \raggedright changes \\
_BREAK = r" \\ "
_WIDE_COLUMN = 36
"""Characters from which on a column breaks its lines."""

_TABLE: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("latex.toml").read_text(encoding="utf-8")
)
_SYMBOLS, _WORDS, _ACCENTS = _TABLE["symbols"], _TABLE["words"], _TABLE["accents"]
"""How LaTeX writes characters: as mathematics, outside it, and combining ones."""
_WITH_ACCENTS = re.compile(r".[\u0300-\u036f]*", re.DOTALL)
"""A character with the combining ones that follow it."""
_LATIN = range(0xC0, 0x180)  # letters that LaTeX's own UTF-8 input knows
_TYPESET = re.compile(
    r"(?<![\w.])(?P<mantissa>[-−]?\d+(?:\.\d+)?)e(?P<power>[-+]?\d{1,3})(?!\w)"
    r"|(?<=\w)[_^]\("
    r"|(?<=(?<![A-Za-z0-9_])[A-Za-z])_(?P<letter>[A-Za-z0-9])(?!\w)"
)
_DEEPEST, _LONGEST_SCRIPT = 4, 200
"""Limits of nested and of long sub- and superscripts; beyond, the text stays as it is."""


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
    r"""Write tables into a folder, each as ``NAME.tex`` for LaTeX's \input and as ``NAME.csv``.

    Returns:
        The written files.

    Raises:
        MachineError: a file cannot be written.
    """
    return [
        write_whole(folder / f"{table.name}.{ending}", content)
        for table in tables
        for ending, content in (("tex", as_latex(table)), ("csv", as_csv(table)))
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


def _kind(column: Sequence[str], number: int) -> str:
    """Return the kind of a column: numbers at the right, long texts in lines."""
    texts = [cell for cell in column if cell]
    if number and texts and 2 * sum(bool(_NUMERIC.fullmatch(cell)) for cell in texts) > len(texts):
        return "r"
    longest = max(map(len, column), default=0)
    return _LINES if longest > _WIDE_COLUMN and number else "l"


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
    matches = [_NUMBER.fullmatch(cell) for cell in column]
    decimals = [len(match[1] or "") for match in matches if match]
    most_digits = max(decimals, default=0)
    cells = []
    for cell, number in zip(column, matches, strict=True):
        if number is None:
            cells.append("--" if cell == NONE else latex_text(cell))
            continue
        digit_count = len(number[1] or "")
        zeros = "0" * (most_digits - digit_count)
        padding = "." + zeros if zeros and not digit_count else zeros
        sign, digits = (r"\ensuremath{-}", cell[1:]) if cell[0] in "-−" else ("", cell)
        cells.append(sign + digits + (rf"\phantom{{{padding}}}" if padding else ""))
    return cells


def latex_text(text: str, depth: int = 0) -> str:
    """Return a text for LaTeX: special characters escaped, symbols as mathematics.

    A number with an exponent, as 1.2e-05, becomes 1.2 × 10⁻⁵; e_c gets a subscript, e^(−αt) a
    superscript. A character that pdfLaTeX does not have becomes a question mark.
    """
    parts, end = [], 0
    for match in _TYPESET.finditer(text):
        if match.start() < end:  # inside a superscript
            continue
        begin, text_end = match.span("letter")
        match_end = text_end
        if match["power"]:
            mantissa = match["mantissa"].replace("−", "-")
            power = match["power"].removeprefix("+")
            typeset, match_end = rf"\ensuremath{{{mantissa}\times10^{{{int(power)}}}}}", match.end()
        else:
            if match["letter"] is None:
                begin = match.end()
                if depth == _DEEPEST or (text_end := _closing(text, begin)) < 0:
                    continue
                match_end = text_end + 1
            command = "superscript" if text[match.start()] == "^" else "subscript"
            typeset = rf"\text{command}{{{latex_text(text[begin:text_end], depth + 1)}}}"
        parts += [_plain(text[end : match.start()]), typeset]
        end = match_end
    return "".join(parts) + _plain(text[end:])


def _closing(text: str, begin: int) -> int:
    """Return the place of the parenthesis that closes the one before ``begin``, or −1."""
    depth = 1
    for index in range(begin, min(len(text), begin + _LONGEST_SCRIPT)):
        depth += {"(": 1, ")": -1}.get(text[index], 0)
        if not depth:
            return index
    return -1


def _plain(text: str) -> str:
    return "".join(map(_character, _WITH_ACCENTS.findall(text)))


def _character(character: str) -> str:
    """Return a character, with the combining ones that follow it, for LaTeX."""
    base, accents = character[0], character[1:]
    if accents:
        text = _SYMBOLS.get(base, base if base.isascii() and base.isalnum() else "")
        if not text or set(accents) - _ACCENTS.keys():
            return _character(unicodedata.normalize("NFC", character)[0])
        for accent in accents:
            text = f"{_ACCENTS[accent]}{{{text}}}"
        return rf"\ensuremath{{{text}}}"
    if base in _SYMBOLS:
        return rf"\ensuremath{{{_SYMBOLS[base]}}}"
    if base in _WORDS:
        return _WORDS[base]
    if ord(base) > _LATIN.stop and len(parts := unicodedata.normalize("NFD", base)) > 1:
        return _character(parts)
    is_known = (base.isascii() and base.isprintable()) or ord(base) in _LATIN
    return base if is_known else "?"

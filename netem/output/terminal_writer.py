"""Writes a document, or a table of it, on a terminal."""

from collections.abc import Iterator

from rich.box import HEAVY_HEAD, SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from netem.output.document import Document, Sentence, SentenceRole
from netem.output.result_tables import ResultTable, Tone

_APART = 3
"""Largest distance between columns of a table that is split, margins included."""
_STYLES = {
    Tone.GOOD: "green", Tone.DOUBTFUL: "yellow", Tone.BAD: "bold red", Tone.NEUTRAL: "", Tone.QUIET: "dim",
}  # fmt: skip


def print_document(console: Console, document: Document) -> None:
    """Print sentences and tables; a page has the figures and the folded texts."""
    for block in document.blocks:
        if isinstance(block, ResultTable):
            parts = _fitting(block, console.width) if block.splits else [terminal_table(block)]
            for part in parts:
                console.print(part)
            if block.more:
                console.print(block.more, highlight=False, markup=False)
        elif isinstance(block, Sentence) and block.on_terminal:
            _print_sentence(console, block)


def _print_sentence(console: Console, sentence: Sentence) -> None:
    style = "dim" if sentence.role == SentenceRole.NOTE else _STYLES[sentence.tone]
    line = Text(sentence.text, style)
    if sentence.lead:
        line = Text.assemble((sentence.lead, style), f" {sentence.text}")
    console.print(
        line, highlight=False, soft_wrap=not (sentence.is_prose or sentence.role == SentenceRole.NOTE)
    )


def terminal_table(table: ResultTable) -> Table:
    """Return a table for a terminal, with the rows that are for it."""
    if not table.headings:  # words and what they are about
        return _listing(table)
    dense = table.is_dense
    rich_table = Table(
        title=escape(table.caption) if table.caption else None,
        box=SIMPLE_HEAD if dense else HEAVY_HEAD,
        collapse_padding=dense,
        pad_edge=not dense,
    )
    left = table.left_columns
    for i, heading in enumerate(table.headings):
        words = " ".join([heading, *(row[i] for row in table.rows)]).split()
        rich_table.add_column(
            escape(heading),
            justify="left" if i in left else "right",
            min_width=max(map(len, words)) if dense else None,
            no_wrap=dense and i not in left,
        )
    for *cells, last in table.rows_on_terminal:
        rich_table.add_row(*map(escape, cells), Text(last, _STYLES[table.tone_of(len(cells), last)]))
    return rich_table


def _listing(table: ResultTable) -> Table:
    """Return a table without headings; the tones are those of its first column."""
    rich_table = Table.grid(padding=(0, 2))
    for first, *cells in table.rows:
        rich_table.add_row(Text(first, _STYLES[table.tone_of(0, first)]), *map(escape, cells))
    return rich_table


def _fitting(table: ResultTable, width: int) -> Iterator[Table]:
    """Yield the tables into which a wide one is split; columns that do not vary are in its caption."""
    varying, names = without_constants(table, table.names)
    return split_table(varying._replace(rows=varying.rows_on_terminal), names, width)


def without_constants(table: ResultTable, names: int) -> tuple[ResultTable, int]:
    """Move columns with the same text in all rows to the caption; return how many labels are left.

    The first ``names`` columns are labels. A table of one row is returned as it is, as is one in
    which no other column varies.
    """
    columns = list(zip(*table.rows, strict=True))
    varying = [i for i, column in enumerate(columns) if len(set(column)) > 1]
    if len(varying) == len(columns) or all(i < names for i in varying):
        return table, names
    constants = (f"{table.headings[i]} {columns[i][0]}" for i in range(len(columns)) if i not in varying)
    left = table._replace(
        caption=f"{table.caption}; everywhere {', '.join(constants)}",
        headings=[table.headings[i] for i in varying],
        rows=[[row[i] for i in varying] for row in table.rows],
    )
    return left, sum(i < names for i in varying)


def split_table(table: ResultTable, names: int, width: int) -> Iterator[Table]:
    """Split a table into as many tables as a terminal of this width needs; nothing is truncated.

    Each has the first ``names`` columns, which are labels.
    """
    columns = list(zip(table.headings, *table.rows, strict=True))
    # A heading may break between words.
    widths = [max(map(len, (*head.split(), *cells))) + _APART for head, *cells in columns]
    begin = names
    while begin < len(columns):
        end = begin + 1
        while end < len(columns) and sum(widths[:names]) + sum(widths[begin : end + 1]) <= width:
            end += 1
        part = Table(
            title=escape(table.caption) if begin == names else None,
            title_justify="left",
            box=SIMPLE_HEAD,
            pad_edge=False,
            collapse_padding=True,
        )
        shown = [*range(names), *range(begin, end)]
        unbroken = sum(max(len(table.headings[i]) + _APART, widths[i]) for i in shown)
        for i in shown:
            part.add_column(
                escape(table.headings[i]),
                justify="left" if i < names else "right",
                overflow="fold",
                min_width=None if i < names else widths[i] - _APART,
                max_width=widths[i] - _APART if unbroken > width else None,
            )
        for row in table.rows:
            part.add_row(*(escape(row[i]) for i in shown))
        yield part
        begin = end

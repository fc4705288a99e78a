"""Writes a document, or a table of it, on a terminal."""

from rich.box import HEAVY_HEAD, SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cosim.output.document import Document, Sentence, SentenceRole
from cosim.output.result_tables import ResultTable, Tone

_STYLES = {
    Tone.GOOD: "green", Tone.DOUBTFUL: "yellow", Tone.BAD: "bold red", Tone.NEUTRAL: "", Tone.QUIET: "dim",
}  # fmt: skip


def print_document(console: Console, document: Document) -> None:
    """Print sentences and tables; a page has the figures and the folded texts."""
    for block in document.blocks:
        if isinstance(block, ResultTable):
            console.print(terminal_table(block))
            if block.more:
                console.print(block.more, highlight=False, markup=False)
        elif isinstance(block, Sentence) and block.on_terminal:
            _print_sentence(console, block)


def _print_sentence(console: Console, sentence: Sentence) -> None:
    style = "dim" if sentence.role == SentenceRole.NOTE else _STYLES[sentence.tone]
    line = Text(sentence.text, style)
    if sentence.lead:
        line = Text.assemble((sentence.lead, style), f" {sentence.text}")
    console.print(line, highlight=False, soft_wrap=sentence.role != SentenceRole.NOTE)


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
    left = range(table.names) if table.left is None else table.left
    for i, heading in enumerate(table.headings):
        words = " ".join([heading, *(row[i] for row in table.rows)]).split()
        rich_table.add_column(
            escape(heading),
            justify="left" if i in left else "right",
            min_width=max(map(len, words)) if dense else None,
            no_wrap=dense and i not in left,
        )
    for *cells, last in table.rows_on_terminal:
        rich_table.add_row(*map(escape, cells), _toned(last, table))
    return rich_table


def _listing(table: ResultTable) -> Table:
    """Return a table without headings; the tones are those of its first column."""
    rich_table = Table.grid(padding=(0, 2))
    for first, *cells in table.rows:
        rich_table.add_row(_toned(first, table), *map(escape, cells))
    return rich_table


def _toned(text: str, table: ResultTable) -> Text:
    tone = next((tone for word, tone in table.tones.items() if text.startswith(word)), Tone.NEUTRAL)
    return Text(text, _STYLES[tone])

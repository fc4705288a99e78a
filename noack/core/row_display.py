"""Formats rows of texts for a terminal and for a notebook."""

import html
import unicodedata
from collections.abc import Sequence

Rows = Sequence[Sequence[str]]
"""The first entry of a row is its name."""
_CELL = 'style="text-align: left; vertical-align: top; line-height: 1.4"'
"""At the cells, since the style sheets of notebooks align the text of each cell."""


def as_text(rows: Rows) -> str:
    """Return rows as aligned columns."""
    widths = [max(map(_width, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(
            entry + " " * (width - _width(entry)) for entry, width in zip(row, widths, strict=True)
        )
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def as_html(rows: Rows) -> str:
    """Return rows as an HTML table."""
    body = "".join(
        f'<tr><th scope="row" {_CELL}>{html.escape(name)}</th>'
        + "".join(f"<td {_CELL}>{html.escape(entry)}</td>" for entry in entries)
        + "</tr>"
        for name, *entries in rows
    )
    return f"<table>{body}</table>"


def _width(text: str) -> int:
    """Return the width of a text in columns; a combining character, as in δ̲, has width 0."""
    return sum(not unicodedata.combining(one) for one in text)

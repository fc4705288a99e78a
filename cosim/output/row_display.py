"""Rows of words as a person sees them: in a terminal, in a notebook."""

import html
import unicodedata
from collections.abc import Sequence

Rows = Sequence[Sequence[str]]
"""The first entry of a row names it."""


def as_text(rows: Rows) -> str:
    """Rows in columns that line up."""
    widths = [max(map(_width, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(
            entry + " " * (width - _width(entry)) for entry, width in zip(row, widths, strict=True)
        )
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def as_html(rows: Rows) -> str:
    """Rows as a table of HTML."""
    body = "".join(
        f"<tr><th>{html.escape(name)}</th>"
        + "".join(f'<td style="text-align: left">{html.escape(entry)}</td>' for entry in entries)
        + "</tr>"
        for name, *entries in rows
    )
    return f"<table>{body}</table>"


def _width(text: str) -> int:
    """Columns that a text takes: a combining sign stands on another, as the line in δ̲."""
    return sum(not unicodedata.combining(one) for one in text)

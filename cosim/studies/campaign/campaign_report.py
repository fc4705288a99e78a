"""Writes the results of a campaign into its folder and prints them."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.studies.campaign.campaign_figures import figures
from cosim.studies.campaign.campaign_page import (
    SummaryRow,
    compared_row,
    found_row,
    page,
    unfinished,
    verdict,
)
from cosim.studies.campaign.campaign_summary import CampaignSummary
from cosim.studies.campaign.chunk_store import RUNS, Store
from cosim.studies.campaign.metrics import METRICS
from noack.core.file_access import write_whole

PAGE, SUMMARY = "campaign.html", "summary.json"
_MOST_ROWS = 40
_APART = 3
"""Largest distance between columns, margins included."""
_MOST_REMARKS = 5


def write_report(summary: CampaignSummary, store: Store, base: Mapping[str, Any]) -> list[Path]:
    """Write page and summary; return their paths and the path of the runs.

    Raises:
        MachineError: they cannot be written.
    """
    written = [store.folder / PAGE, store.folder / SUMMARY]
    html = page(summary, list(figures(summary, store)), base)
    document = json.dumps(_known(summary.document()), indent=1, allow_nan=False)
    for path, text in zip(written, (html, document + "\n"), strict=True):
        write_whole(path, text)
    return [*written, store.folder / RUNS]


def print_summary(console: Console, summary: CampaignSummary) -> None:
    """Print the tables of a summary."""
    campaign = summary.campaign
    shown = campaign.metrics.shown
    tables = [
        (
            f"{campaign.name}: {summary.draws:,} draws",
            [found_row(one, shown) for one in summary.found],
        )
    ]
    if campaign.compare is not None:
        title = f"paired difference to {campaign.compare.axis} = {campaign.compare.reference}"
        tables.append((title, [compared_row(one, shown) for one in summary.compared]))
    axes = [axis.called for axis in campaign.axes]
    headings = [METRICS[metric].heading for metric in shown]
    for title, rows in tables:
        for table in tables_of(title, axes, headings, rows[:_MOST_ROWS], console.width):
            console.print(table)
        if len(rows) > _MOST_ROWS:
            console.print(f"and {len(rows) - _MOST_ROWS} more grid points: see the page")
    if campaign.time == "continuous":
        console.print(
            "continuous time: the trigger acts at once and the network has no delay; with "
            'time = "sampled" the runs have the sampling and delays of a live run',
            style="dim",
            highlight=False,
        )
    remarks = list(unfinished(summary))
    for remark in remarks[:_MOST_REMARKS]:
        console.print(remark, style="yellow", markup=False, highlight=False)
    if len(remarks) > _MOST_REMARKS:
        console.print(f"and at {len(remarks) - _MOST_REMARKS} more grid points: see the page")
    console.print(verdict(summary), style="bold red" if summary.breaches else "bold")


def tables_of(
    title: str, axes: Sequence[str], headings: Sequence[str], rows: Sequence[SummaryRow], width: int
) -> Iterator[Table]:
    """Split a table into as many tables as a terminal of this width needs; nothing is truncated.

    Args:
        title: of the first table.
        axes: headings of the label columns, which each table repeats.
        headings: headings of the other columns.
        rows: rows of all tables.
        width: in characters.
    """
    labels = sum(_width(axis, [row.labels[i] for row in rows]) for i, axis in enumerate(axes))
    widths = [_width(words, [row.cells[i] for row in rows]) for i, words in enumerate(headings)]
    begin = 0
    while begin < len(headings):
        end = begin + 1
        while end < len(headings) and labels + sum(widths[begin : end + 1]) <= width:
            end += 1
        table = Table(
            title=escape(title) if begin == 0 else None, title_justify="left", box=SIMPLE_HEAD,
            pad_edge=False, collapse_padding=True,
        )  # fmt: skip
        for words in axes:
            table.add_column(escape(words), overflow="fold")
        for words, least in zip(headings[begin:end], widths[begin:end], strict=True):
            table.add_column(escape(words), justify="right", min_width=least - _APART)
        for row in rows:
            table.add_row(*map(escape, row.labels), *row.cells[begin:end])
        yield table
        begin = end


def _width(heading: str, cells: Iterable[str]) -> int:
    """Width of a column; its heading may break between words."""
    return max(map(len, (*heading.split(), *cells))) + _APART


def _known(value: Any) -> Any:
    """Return the value for JSON: null for a number that is not finite."""
    if isinstance(value, dict):
        return {key: _known(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_known(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

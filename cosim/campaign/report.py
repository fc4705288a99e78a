"""Writes what a campaign found into its folder, and prints it."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.campaign.figures import figures
from cosim.campaign.metrics import METRICS
from cosim.campaign.page import compared_row, found_row, page, unfinished, verdict
from cosim.campaign.store import RUNS, Store
from cosim.campaign.summary import Summary
from noack.errors import MachineError

PAGE, SUMMARY = "campaign.html", "summary.json"
_MOST_ROWS = 40
_MOST_REMARKS = 5


def write_report(summary: Summary, store: Store, base: Mapping[str, Any]) -> list[Path]:
    """Write page and summary; return the paths of what is to be looked at.

    Raises:
        MachineError: they cannot be written.
    """
    written = [store.folder / PAGE, store.folder / SUMMARY]
    html = page(summary, list(figures(summary, store)), base)
    document = json.dumps(_known(summary.document()), indent=1, allow_nan=False)
    try:
        for path, text in zip(written, (html, document + "\n"), strict=True):
            scratch = path.with_name(f".{path.name}.partial")
            scratch.write_text(text, encoding="utf-8")
            scratch.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise MachineError(f"{store.folder}: the page cannot be written: {reason}") from None
    return [*written, store.folder / RUNS]


def print_summary(console: Console, summary: Summary) -> None:
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
        title = f"minus the same draw at {campaign.compare.axis} = {campaign.compare.reference}"
        tables.append((title, [compared_row(one, shown) for one in summary.compared]))
    for title, rows in tables:
        table = Table(title=escape(title), title_justify="left")
        for axis in campaign.axes:
            table.add_column(escape(axis.called))
        for metric in shown:
            table.add_column(escape(METRICS[metric].heading), justify="right")
        for row in rows[:_MOST_ROWS]:
            table.add_row(*map(escape, row.labels), *row.cells)
        console.print(table)
        if len(rows) > _MOST_ROWS:
            console.print(f"and {len(rows) - _MOST_ROWS} more grid points: see the page")
    remarks = list(unfinished(summary))
    for remark in remarks[:_MOST_REMARKS]:
        console.print(remark, style="yellow", markup=False, highlight=False)
    if len(remarks) > _MOST_REMARKS:
        console.print(f"and at {len(remarks) - _MOST_REMARKS} more grid points: see the page")
    console.print(verdict(summary), style="bold red" if summary.breaches else "bold")


def _known(value: Any) -> Any:
    """As JSON knows it: null for what is not finite."""
    if isinstance(value, dict):
        return {key: _known(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_known(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

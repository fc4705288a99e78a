"""The results of a campaign as a page, as JSON, and as tables for a terminal."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w
from pydantic_core import to_json
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.output.figure_files import save_figures
from cosim.output.figure_format import FigureFiles
from cosim.output.page_kit import templates
from cosim.output.result_tables import ResultTable
from cosim.studies.campaign.campaign_figures import figures
from cosim.studies.campaign.campaign_summary import CampaignSummary, GridPointResult
from cosim.studies.campaign.chunk_store import RUNS, Store
from cosim.studies.campaign.metrics import METRICS, Estimate
from noack.core.file_access import write_whole
from noack.core.number_format import plus_minus

PAGE, SUMMARY = "campaign.html", "summary.json"
_NONE = "–"
_MOST_ROWS = 40
_APART = 3
"""Largest distance between columns, margins included."""
_MOST_REMARKS = 5


class SummaryRow(NamedTuple):
    """A row of a table of grid points."""

    labels: Sequence[str]
    cells: Sequence[str]


def write_report(
    summary: CampaignSummary,
    store: Store,
    base: Mapping[str, Any],
    figure_files: FigureFiles | None = None,
) -> list[Path]:
    """Write page, summary and figures; return their paths and the path of the runs.

    Raises:
        MachineError: they cannot be written.
    """
    document = to_json(summary.document(), indent=1, inf_nan_mode="null")
    return [
        write_whole(store.folder / PAGE, page(summary, store, base)),
        write_whole(store.folder / SUMMARY, document + b"\n"),
        store.folder / RUNS,
        *save_figures(figures(summary, store), store.folder / PAGE, figure_files),
    ]  # fmt: skip


def campaign_tables(summary: CampaignSummary) -> Iterator[ResultTable]:
    """Yield the means of all grid points, and their paired differences to the reference."""
    campaign = summary.campaign
    headings = [axis.called for axis in campaign.axes]
    headings += [METRICS[name].heading for name in campaign.metrics.shown]
    tables = [("campaign", f"{summary.draws:,} draws; mean ± half-width", _rows(summary))]
    if campaign.compare is not None:
        what = f"paired difference to {_reference(summary)}"
        tables.append(("differences", what, _differences(summary)))
    for name, what, rows in tables:
        cells = [(*row.labels, *row.cells) for row in rows]
        yield ResultTable(name, f"{campaign.name}: {what}", headings, cells)


def page(summary: CampaignSummary, store: Store, base: Mapping[str, Any]) -> str:
    """Return the page as HTML; all text except the figures is escaped.

    ``base`` is the content of the scenario of all runs.
    """
    campaign = summary.campaign
    content = campaign.model_dump(mode="json", exclude_none=True)
    remarks = list(_unfinished(summary))
    return templates(Path(__file__).parent).get_template("campaign.html.jinja").render(
        title=campaign.name,
        description=campaign.description,
        subtitle=f"{len(summary.found):,} grid points, {summary.draws:,} draws at each, "
        f"seed {campaign.seed}",
        verdict=_verdict(summary),
        tone="bad" if summary.breaches else "doubt" if remarks else "good",
        remarks=[*remarks, *_bursts(summary)],
        figures=list(figures(summary, store)),
        axes=[axis.called for axis in campaign.axes],
        metrics=[METRICS[name].heading for name in campaign.metrics.shown],
        rows=[(*row.labels, *row.cells) for row in _rows(summary)],
        reference=_reference(summary),
        differences=[(*row.labels, *row.cells) for row in _differences(summary, shares=True)],
        campaign_toml=tomli_w.dumps(content, indent=2),
        scenario_toml=tomli_w.dumps(base, indent=2),
    )  # fmt: skip


def print_summary(console: Console, summary: CampaignSummary) -> None:
    """Print the tables of a summary."""
    campaign = summary.campaign
    tables = [(f"{campaign.name}: {summary.draws:,} draws", _rows(summary))]
    if campaign.compare is not None:
        tables.append((f"paired difference to {_reference(summary)}", _differences(summary)))
    axes = [axis.called for axis in campaign.axes]
    headings = [METRICS[metric].heading for metric in campaign.metrics.shown]
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
    remarks = [*_unfinished(summary), *_bursts(summary)]
    for remark in remarks[:_MOST_REMARKS]:
        console.print(remark, style="yellow", markup=False, highlight=False)
    if len(remarks) > _MOST_REMARKS:
        console.print(f"and at {len(remarks) - _MOST_REMARKS} more grid points: see the page")
    console.print(_verdict(summary), style="bold red" if summary.breaches else "bold")


def tables_of(
    title: str, axes: Sequence[str], headings: Sequence[str], rows: Sequence[SummaryRow], width: int
) -> Iterator[Table]:
    """Split a table into as many tables as a terminal of this width needs; nothing is truncated.

    Each table repeats the label columns, whose headings are ``axes``.
    """
    axis_widths = [_width(axis, [row.labels[i] for row in rows]) for i, axis in enumerate(axes)]
    widths = [_width(words, [row.cells[i] for row in rows]) for i, words in enumerate(headings)]
    labels, begin = sum(axis_widths), 0
    while begin < len(headings):
        end = begin + 1
        while end < len(headings) and labels + sum(widths[begin : end + 1]) <= width:
            end += 1
        table = Table(
            title=escape(title) if begin == 0 else None, title_justify="left", box=SIMPLE_HEAD,
            pad_edge=False, collapse_padding=True,
        )  # fmt: skip
        columns = [*zip(axes, axis_widths, strict=True)]
        columns += zip(headings[begin:end], widths[begin:end], strict=True)
        unbroken = sum(max(len(words) + _APART, least) for words, least in columns)
        for place, (words, least) in enumerate(columns):
            table.add_column(
                escape(words),
                justify="right" if place >= len(axes) else "left",
                overflow="fold",
                min_width=least - _APART if place >= len(axes) else None,
                max_width=least - _APART if unbroken > width else None,
            )
        for row in rows:
            table.add_row(*map(escape, row.labels), *row.cells[begin:end])
        yield table
        begin = end


def _width(heading: str, cells: Sequence[str]) -> int:
    """Return the width of a column; its heading may break between words."""
    return max(map(len, (*heading.split(), *cells))) + _APART


def _verdict(summary: CampaignSummary) -> str:
    runs = len(summary.found) * summary.draws
    certified = sum(found.point.certified_error is not None for found in summary.found)
    if summary.breaches:
        return f"{summary.breaches:,} of {runs:,} runs exceed a certified bound."
    if not certified:
        return (
            f"{runs:,} runs; no grid point has a certified bound "
            "(a hold, a floor and other policies have none)."
        )
    where = "all" if certified == len(summary.found) else f"{certified} of {len(summary.found)}"
    return f"{runs:,} runs; {where} grid points have a certified bound; none was exceeded."


def _rows(summary: CampaignSummary) -> list[SummaryRow]:
    """Return each grid point's means with their intervals."""
    return [
        SummaryRow(
            list(found.point.labels.values()),
            [written(found.estimates.get(metric)) for metric in summary.campaign.metrics.shown],
        )
        for found in summary.found
    ]


def _differences(summary: CampaignSummary, *, shares: bool = False) -> list[SummaryRow]:
    """Return mean differences, optionally with the share of draws with a smaller metric."""
    rows = []
    for compared in summary.compared:
        cells = []
        for metric in summary.campaign.metrics.shown:
            found = compared.differences.get(metric)
            cells.append(written(found.estimate if found and found.estimate.finite else None))
            if found and shares:
                cells[-1] += f", smaller in {100 * found.smaller:.3g} %"
        rows.append(SummaryRow(list(compared.point.labels.values()), cells))
    return rows


def _reference(summary: CampaignSummary) -> str | None:
    campaign = summary.campaign
    if campaign.compare is None:
        return None
    return f"{campaign.by_name[campaign.compare.axis].called} = {campaign.compare.reference}"


def written(estimate: Estimate | None) -> str:
    """Return mean ± half-width, with the share of finite runs if it is below 100 %."""
    if estimate is None:
        return _NONE
    if not estimate.finite:
        return "never"
    text = plus_minus(estimate.mean, estimate.halfwidth)
    if estimate.finite < estimate.draws:
        text += f" ({100 * estimate.finite / estimate.draws:.4g} % of runs)"
    return text


def _unfinished(summary: CampaignSummary) -> Iterator[str]:
    """Return a note for each grid point at which a run did not reach the horizon."""
    for found in summary.found:
        others = {how: count for how, count in found.ended.items() if how != "finished"}
        if others:
            counts = ", ".join(f"{n:,} {how.replace('_', ' ')}" for how, n in others.items())
            yield f"{_at(found)} not all runs reached the horizon: {counts}"


def _bursts(summary: CampaignSummary) -> Iterator[str]:
    """Return, for each grid point without an enforced guarantee, how often it was exceeded."""
    for found in summary.found:
        if found.bursts is not None:
            yield f"{_at(found)} {found.bursts.text}"


def _at(found: GridPointResult) -> str:
    return "At " + ", ".join(f"{axis} {label}" for axis, label in found.point.labels.items())

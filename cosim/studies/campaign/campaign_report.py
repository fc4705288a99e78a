"""A campaign from its grid to its results: as a page, as JSON, and as tables for a terminal."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import NamedTuple

import tomli_w
from pydantic_core import to_json

from cosim.output.figures.figure_files import save_figures
from cosim.output.figures.figure_format import FigureFiles
from cosim.output.figures.page_figure import figures_of
from cosim.output.page_kit import document_page
from cosim.record.run_directory import CAMPAIGN_PAGE, SUMMARY_FILE, read_object
from cosim.studies.campaign.campaign_figures import figures
from cosim.studies.campaign.campaign_file import MOST_DRAWS, Campaign
from cosim.studies.campaign.campaign_grid import base_of, grid
from cosim.studies.campaign.campaign_summary import CampaignSummary, summarise
from cosim.studies.campaign.campaign_workers import Runner
from cosim.studies.campaign.chunk_store import RUNS, Store, locked_folder, run_campaign
from cosim.studies.campaign.metrics import Estimate, Metric, to_shown_unit
from netem.core.command_line import stop_requests_raised
from netem.core.file_access import write_whole
from netem.core.number_checks import whole_number
from netem.core.number_format import plus_minus
from netem.output.document import Block, Document, Folded, Heading, Sentence, SentenceRole
from netem.output.result_tables import ResultTable, Tone
from noack.core.progress import Progress, no_progress

PAGE, SUMMARY = CAMPAIGN_PAGE, SUMMARY_FILE
_NONE = "–"
_MOST_ROWS = 40
"""Rows of a table in the terminal."""
_MOST_REMARKS = 5
"""Remarks in the terminal."""
_PAIRED = (
    "Draw i has the same plant, initial state and losses everywhere: what is left of a difference is "
    "due to the settings."
)
_INTERVALS = (
    "Intervals are Student's t, of the runs in which the metric is finite; quantiles are in summary.json."
)
_CONTINUOUS = (
    "continuous time: the trigger acts at once and the network has no delay; with "
    'time = "sampled" the runs have the sampling and delays of a live run'
)


def write_report(
    summary: CampaignSummary,
    store: Store,
    base: Mapping[str, object],
    figure_files: FigureFiles | None = None,
) -> list[Path]:
    """Write page, summary and figures; return their paths and the path of the runs.

    Raises:
        MachineError: they cannot be written.
    """
    document = campaign_document(summary, store, base)
    content = to_json(document.data, indent=1, inf_nan_mode="null")
    return [
        write_whole(store.folder / PAGE, document_page(document)),
        write_whole(store.folder / SUMMARY, content + b"\n"),
        store.folder / RUNS,
        *save_figures(figures_of(document), store.folder / PAGE, figure_files),
    ]


def had_more_draws(folder: Path, draws: int) -> bool:
    """Return whether the summary in a folder is that of more draws."""
    earlier = read_object(folder / SUMMARY).get("draws")
    return isinstance(earlier, int) and earlier > draws


def campaign_tables(summary: CampaignSummary, *, shares: bool = False) -> Iterator[ResultTable]:
    """Yield the means of all grid points, and their paired differences.

    With ``shares``, the differences have the share of draws in which a metric is smaller, too.
    """
    campaign, metric_names = summary.campaign, summary.campaign.metrics.shown
    headings = [
        *(axis.name_in_figures for axis in campaign.axes),
        *(campaign.metrics.heading(name) for name in metric_names),
    ]
    means = [
        (
            *result.point.labels.values(),
            *(metric_text(name, result.estimates.get(name)) for name in metric_names),
        )
        for result in summary.results
    ]
    title = f"{campaign.name}: {summary.draws:,} draws; mean ± half-width of its 95 % interval"
    yield ResultTable("campaign", title, headings, means)
    if campaign.compare is not None:
        differences = []
        for compared in summary.compared:
            cells = []
            for name in metric_names:
                paired = compared.differences.get(name)
                cells.append(
                    metric_text(name, paired.estimate if paired and paired.estimate.finite else None)
                )
                if paired and shares:
                    cells[-1] += f", smaller in {100 * paired.smaller:.3g} %"
            differences.append((*compared.point.labels.values(), *cells))
        title = f"{campaign.name}: paired difference to {_reference(summary)}"
        yield ResultTable("differences", title, headings, differences)


def campaign_document(
    summary: CampaignSummary, store: Store | None = None, base: Mapping[str, object] | None = None
) -> Document:
    """Return the tables, remarks and verdict of a campaign.

    With its store and ``base``, the content of the scenario of all runs, it is that of the page,
    which has the figures and the scenarios.
    """
    campaign, is_page = summary.campaign, store is not None
    unfinished = [*_unfinished(summary)]
    remarks = [*unfinished, *_bursts(summary)]
    more = len(remarks) - _MOST_REMARKS
    more_text = f"and at {more} more grid points: see the page"
    tone = Tone.GOOD if _certified(summary) else Tone.NEUTRAL
    tone = Tone.DOUBTFUL if unfinished else tone
    blocks: list[Block] = []
    if store is not None and campaign.figures:
        blocks += [Heading("Figures"), *figures(summary, store)]
    blocks.append(Heading("Grid points"))
    for table in campaign_tables(summary, shares=is_page):
        if table.name == "differences":
            blocks += [Heading("Differences draw by draw"), Sentence(text=_PAIRED, on_terminal=False)]
        surplus = len(table.rows) - _MOST_ROWS
        blocks.append(
            table._replace(
                names=len(campaign.axes),
                splits=True,
                shown=range(_MOST_ROWS),
                more=f"and {surplus} more grid points: see the page" if surplus > 0 else "",
            )
        )
    if campaign.time == "continuous":
        blocks.append(Sentence(text=_CONTINUOUS, role=SentenceRole.NOTE))
    if ties := [result.point.tie for result in summary.results if result.point.tie]:
        text = f"at {len(ties)} of {len(summary.results)} grid points, {ties[0]}"
        blocks.append(Sentence(text=text, role=SentenceRole.NOTE))
    blocks += [
        Sentence(text=_INTERVALS, on_terminal=False),
        *(
            Sentence(
                text=text, role=SentenceRole.REMARK, tone=Tone.DOUBTFUL, is_prose=True,
                on_terminal=number < _MOST_REMARKS,
            )
            for number, text in enumerate(remarks)
        ),
        *([Sentence(text=more_text, on_page=False)] if more > 0 else []),
        Sentence(
            text=_verdict(summary), role=SentenceRole.VERDICT, is_prose=True,
            tone=Tone.BAD if summary.breaches else tone,
        ),
    ]  # fmt: skip
    if base is not None:
        content = campaign.model_dump(mode="json", exclude_none=True)
        blocks += [
            Heading("What was run"),
            Folded("The campaign (TOML)", tomli_w.dumps(content, indent=2)),
            Folded("The scenario that all runs start from (TOML)", tomli_w.dumps(base, indent=2)),
        ]
    return Document(
        title=campaign.name,
        kind="campaign",
        subtitle=f"{len(summary.results):,} grid points, {summary.draws:,} draws at each, "
        f"seed {campaign.seed}",
        description=campaign.description,
        data=summary.to_json(),
        blocks=blocks,
    )


def _verdict(summary: CampaignSummary) -> str:
    runs = len(summary.results) * summary.draws
    certified = _certified(summary)
    if summary.breaches:
        return f"{summary.breaches:,} of {runs:,} runs exceed a certified bound."
    if not certified:
        return (
            f"{runs:,} runs; no point of the grid has a certified bound. A bound needs the paper's trigger "
            "without a floor, models that decay faster than the threshold (a hold does not), and an enforced "
            "guarantee."
        )
    extent = "all" if certified == len(summary.results) else f"{certified} of {len(summary.results)}"
    return f"{runs:,} runs; {extent} grid points have a certified bound; none was exceeded."


def _certified(summary: CampaignSummary) -> int:
    """Return the number of grid points with a certified bound."""
    return sum(result.point.certified_error is not None for result in summary.results)


def _reference(summary: CampaignSummary) -> str | None:
    campaign = summary.campaign
    if campaign.compare is None:
        return None
    return f"{campaign.by_name[campaign.compare.axis].name_in_figures} = {campaign.compare.reference}"


def metric_text(metric: Metric, estimate: Estimate | None) -> str:
    """Return mean ± half-width, with the share of finite runs if it is below 100 %."""
    if estimate is None:
        return _NONE
    estimate = to_shown_unit(metric, estimate)
    if not estimate.finite:
        return "never"
    text = plus_minus(estimate.mean, estimate.halfwidth)
    if estimate.finite < estimate.draws:
        text += f" ({100 * estimate.finite / estimate.draws:.4g} % of runs)"
    return text


def _unfinished(summary: CampaignSummary) -> Iterator[str]:
    """Return a note for each grid point at which a run did not reach the horizon."""
    for result in summary.results:
        other_endings = {ending: count for ending, count in result.ended.items() if ending != "finished"}
        if other_endings:
            counts = ", ".join(f"{n:,} {ending.replace('_', ' ')}" for ending, n in other_endings.items())
            yield f"{_point_text(result.point.labels)} not all runs reached the horizon: {counts}"


def _bursts(summary: CampaignSummary) -> Iterator[str]:
    """Return, for each grid point without an enforced guarantee, how often it was exceeded."""
    for result in summary.results:
        if result.bursts is not None:
            yield f"{_point_text(result.point.labels)} {result.bursts.text}"


def _point_text(labels: Mapping[str, str]) -> str:
    return "At " + ", ".join(f"{axis} {label}" for axis, label in labels.items())


Show = Callable[[str], AbstractContextManager[object]]
"""Shows what is done meanwhile."""


class FinishedCampaign(NamedTuple):
    """A campaign without missing runs."""

    summary: CampaignSummary
    store: Store
    made: int
    """Number of runs that were computed now."""
    files: list[Path]
    """The written files."""


def finish_campaign(
    plan: Campaign,
    path: Path,
    folder: Path,
    workers: Callable[[], AbstractContextManager[Runner]],
    *,
    draws: int | None = None,
    figure_files: FigureFiles | None = None,
    show: Show = nullcontext,
    bar: AbstractContextManager[Progress] | None = None,
) -> FinishedCampaign:
    """Run or continue a campaign; write its page.

    Args:
        plan: the campaign.
        path: its file, in whose folder its scenario may be.
        folder: of the campaign.
        workers: starts the workers.
        draws: number of draws; the campaign's by default.
        figure_files: write each figure as a file, too.
        show: shows what is done meanwhile.
        bar: shows how many runs are done.

    Raises:
        CallerError: the campaign does not fit its scenario, or another one is in the folder.
        MachineError: the results cannot be written.
    """
    draws = plan.draws if draws is None else whole_number("draws", draws, 1, MOST_DRAWS)
    with show("preparing the grid"):
        points = grid(plan, path)
    _, base = base_of(plan, path)
    store = Store(folder, points, draws, plan.chunk)
    with stop_requests_raised(), locked_folder(plan, base, store):
        with bar or nullcontext(no_progress) as progress, workers() as runner:
            new_runs = run_campaign(store, runner, progress)
        with show("summarising"):
            summary = summarise(plan, store)
            files = write_report(summary, store, base, figure_files)
    return FinishedCampaign(summary, store, new_runs, files)

"""Functions of all commands that run a campaign: its workers, the campaign itself, its page."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from cosim.cli import command as cli
from noack.core.errors import CallerError

if TYPE_CHECKING:
    from rich.console import Console

    from cosim.output.figure_format import FigureFormat
    from cosim.studies.campaign.campaign_file import Campaign
    from cosim.studies.campaign.campaign_summary import CampaignSummary
    from cosim.studies.campaign.chunk_store import Store

_PER_CORE = 4
"""Maximum worker processes per core; more gain nothing, and use memory."""

Workers = Annotated[
    int | None, typer.Option(help="Worker processes; one per core by default.", min=1)
]


class FinishedCampaign(NamedTuple):
    """A campaign without missing runs."""

    summary: "CampaignSummary"
    store: "Store"
    made: int
    """Number of runs that were computed now."""
    files: list[Path]
    """The written files."""


def worker_pool(workers: int | None, scheduler: str | None = None) -> Callable[[Any], Any]:
    """Return a function that starts the workers; its argument is a function that prints a line."""
    from cosim.studies.campaign.campaign_workers import cluster, local

    if scheduler is not None:
        if workers is not None:
            raise CallerError("--workers: with --scheduler the cluster's workers are used")
        return lambda say: cluster(scheduler, say)
    number = workers or cli.cores()
    if number > (most := _PER_CORE * cli.cores()):
        raise CallerError(f"--workers {number}: on this machine at most {most}")
    return lambda say: local(number)


def execute_campaign(
    console: "Console", plan: "Campaign", path: Path, start: Callable[[Any], Any], *,
    folder: Path, draws: int | None = None, figure_format: "FigureFormat | None" = None,
) -> FinishedCampaign:  # fmt: skip
    """Run or continue a campaign; write its page.

    Args:
        console: shows the progress.
        plan: the campaign.
        path: its file, in whose folder its scenario may be.
        start: starts the workers, see :func:`worker_pool`.
        folder: of the campaign.
        draws: number of draws; the campaign's by default.
        figure_format: write each figure as a file, too.
    """
    from cosim.live.progress import runs_bar
    from cosim.studies.campaign.campaign_grid import base_of, grid
    from cosim.studies.campaign.campaign_report import write_report
    from cosim.studies.campaign.campaign_run import run_campaign, terminations_raised
    from cosim.studies.campaign.campaign_summary import summarise
    from cosim.studies.campaign.chunk_store import Store, opened

    def say(line: str) -> None:
        console.print(f"noack: {line}", highlight=False, markup=False, soft_wrap=True)

    with console.status("preparing the grid"):
        points = grid(plan, path)
    _, base = base_of(plan, path)
    store = Store(folder, points, draws or plan.draws, plan.chunk)
    with terminations_raised(), opened(plan, base, store):
        with start(say) as runner, runs_bar(console) as progress:
            made = run_campaign(store, runner, progress)
        with console.status("summarising"):
            summary = summarise(plan, store)
            files = write_report(summary, store, base, figure_format)
    return FinishedCampaign(summary, store, made, files)

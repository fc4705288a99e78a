"""Functions of all commands that run a campaign: its workers, the campaign itself, its page."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli import command as cli
from noack.core.errors import CallerError

if TYPE_CHECKING:
    from rich.console import Console

    from cosim.output.figure_format import FigureFiles
    from cosim.studies.campaign.campaign_file import Campaign
    from cosim.studies.campaign.finished_campaign import FinishedCampaign

_PER_CORE = 4
"""Maximum worker processes per core; more gain nothing, and use memory."""

Workers = Annotated[
    int | None, typer.Option(help="Worker processes; one per core by default.", min=1)
]


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
    folder: Path, draws: int | None = None, figure_files: "FigureFiles | None" = None,
) -> "FinishedCampaign":  # fmt: skip
    """Run or continue a campaign; write its page.

    Args:
        console: shows the progress.
        plan: the campaign.
        path: its file, in whose folder its scenario may be.
        start: starts the workers, see :func:`worker_pool`.
        folder: of the campaign.
        draws: number of draws; the campaign's by default.
        figure_files: write each figure as a file, too.
    """
    from cosim.live.progress import runs_bar
    from cosim.studies.campaign.finished_campaign import finish_campaign

    def say(line: str) -> None:
        console.print(f"noack: {line}", highlight=False, markup=False, soft_wrap=True)

    return finish_campaign(
        plan, path, folder, lambda: start(say), draws=draws, figure_files=figure_files,
        show=console.status, bar=runs_bar(console),
    )  # fmt: skip

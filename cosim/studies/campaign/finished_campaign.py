"""A whole campaign: its grid, its missing runs, its summary and its page."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

from cosim.output.figure_format import FigureFiles
from cosim.studies.campaign.campaign_file import Campaign
from cosim.studies.campaign.campaign_grid import base_of, grid
from cosim.studies.campaign.campaign_report import write_report
from cosim.studies.campaign.campaign_summary import CampaignSummary, summarise
from cosim.studies.campaign.campaign_workers import Runner
from cosim.studies.campaign.chunk_store import Progress, Store, opened, run_campaign
from noack.runtime.command_line import stop_requests_raised

Show = Callable[[str], AbstractContextManager[object]]
"""Shows what is done meanwhile."""


class FinishedCampaign(NamedTuple):
    """A campaign without missing runs."""

    summary: CampaignSummary
    store: Store
    base: Mapping[str, Any]
    """The content of the scenario of all runs."""
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
    bar: AbstractContextManager[Progress | None] | None = None,
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
    with show("preparing the grid"):
        points = grid(plan, path)
    _, base = base_of(plan, path)
    store = Store(folder, points, draws or plan.draws, plan.chunk)
    with stop_requests_raised(), opened(plan, base, store):
        with workers() as runner, bar or nullcontext() as progress:
            made = run_campaign(store, runner, progress)
        with show("summarising"):
            summary = summarise(plan, store)
            files = write_report(summary, store, base, figure_files)
    return FinishedCampaign(summary, store, base, made, files)

"""``noack campaign``: many runs over a grid of settings."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli import command as cli
from cosim.cli import completion
from noack.core.errors import CallerError, ExitStatus

if TYPE_CHECKING:
    from rich.console import Console

_PER_CORE = 4
"""Maximum worker processes per core; more gain nothing, and use memory."""

Draws = Annotated[
    int | None,
    typer.Option(help="Runs at each grid point; the campaign file's number by default.", min=1),
]
Workers = Annotated[
    int | None, typer.Option(help="Worker processes; one per core by default.", min=1)
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="Run on the Dask cluster of this scheduler."),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", help="Folder of the campaign; runs/campaigns/NAME by default."),
]


@cli.command(cli.CAMPAIGNS, 10, [
    ("noack campaign mb_vs_zoh", "compare a model with a hold"),
    ("noack campaign mansd_sweep --draws 200 --json", "fewer draws at each grid point"),
    ("noack campaign mb_vs_zoh --scheduler tcp://127.0.0.1:8786", "on a Dask cluster"),
])  # fmt: skip
def campaign(
    file: Annotated[
        str,
        typer.Argument(
            help="Campaign file (TOML), or the name of a shipped campaign.",
            autocompletion=completion.campaigns,
        ),
    ],
    *,
    draws: Draws = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    out: Out = None,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario over a grid of settings, with many random draws at each point.

    An interrupted campaign is continued if it is started again with the same folder.

    Exit status 1: a run exceeded a certified bound.
    """
    from cosim.live.progress import PatientConsole
    from cosim.shipped_files import find_shipped
    from cosim.studies.campaign.campaign_report import print_summary

    start = _worker_pool(workers, scheduler)
    console = PatientConsole(stderr=True)
    path = find_shipped(file, "campaigns")
    summary, made, files = _run(console, path, start, draws=draws, out=out)
    if json:
        cli.print_json(summary.document() | {"made": made, "files": [str(file) for file in files]})
    else:
        print_summary(cli.console(), summary)
        for written in files:
            print(written)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK


def _worker_pool(workers: int | None, scheduler: str | None) -> Callable[[Any], Any]:
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


def _run(
    console: "Console", path: Path, start: Callable[[Any], Any], *, draws: int | None,
    out: Path | None,
) -> tuple[Any, int, list[Path]]:  # fmt: skip
    """Run or continue a campaign; return its summary, the number of new runs, the written files."""
    from cosim.live.progress import runs_bar
    from cosim.studies.campaign.campaign_file import load
    from cosim.studies.campaign.campaign_grid import base_of, grid
    from cosim.studies.campaign.campaign_report import write_report
    from cosim.studies.campaign.campaign_run import run_campaign, terminations_raised
    from cosim.studies.campaign.campaign_summary import summarise
    from cosim.studies.campaign.chunk_store import Store, opened

    def say(line: str) -> None:
        console.print(f"noack: {line}", highlight=False, markup=False, soft_wrap=True)

    plan = load(path)
    with console.status("preparing the grid"):
        points = grid(plan, path)
    _, base = base_of(plan, path)
    folder = out or cli.DEFAULT_RUNS / "campaigns" / plan.name
    store = Store(folder, points, draws or plan.draws, plan.chunk)
    with terminations_raised(), opened(plan, base, store):
        with start(say) as runner, runs_bar(console) as progress:
            made = run_campaign(store, runner, progress)
        with console.status("summarising"):
            summary = summarise(plan, store)
            files = write_report(summary, store, base)
    return summary, made, files

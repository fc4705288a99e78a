"""Commands on many runs."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from cosim.cli import completion
from cosim.cli.command import CAMPAIGNS, JsonOption, command, cores, print_json
from cosim.record.run_directory import DEFAULT_RUNS
from noack.core.errors import CallerError, ExitStatus

_PER_CORE = 4
"""More processes gain nothing, and cost memory."""


@command(CAMPAIGNS, [
    ("noack campaign mb_vs_zoh", "what a model saves against a hold"),
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
    draws: Annotated[
        int | None, typer.Option(help="Runs at each grid point; the file's unless given.", min=1)
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes; as many as cores unless given.", min=1)
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="Run on the Dask cluster of this scheduler."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The campaign's folder; runs/campaigns/NAME unless given."),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Run a scenario over a grid of settings, many draws at each; say what differs, and how surely.

    Takes up what a run that was cut short left in the same folder.
    """
    from cosim.live.progress import PatientConsole, runs_bar
    from cosim.shipped_files import find_shipped
    from cosim.studies.campaign.campaign_file import load
    from cosim.studies.campaign.campaign_grid import base_of, grid
    from cosim.studies.campaign.campaign_report import print_summary, write_report
    from cosim.studies.campaign.campaign_run import run_campaign, terminations_raised
    from cosim.studies.campaign.campaign_summary import summarise
    from cosim.studies.campaign.campaign_workers import cluster, local
    from cosim.studies.campaign.chunk_store import Store, opened

    if scheduler is not None and workers is not None:
        raise CallerError("--workers: with --scheduler the cluster's workers are taken")
    path = find_shipped(file, "campaigns")
    plan = load(path)
    console = PatientConsole(stderr=True)
    with console.status("preparing the grid"):
        points = grid(plan, path)
    _, base = base_of(plan, path)
    folder = out or DEFAULT_RUNS / "campaigns" / plan.name
    store = Store(folder, points, draws or plan.draws, plan.chunk)
    workers = workers or cores()
    if workers > (most := _PER_CORE * cores()):
        raise CallerError(f"--workers {workers}: on this machine at most {most}")

    def say(line: str) -> None:
        console.print(f"noack: {line}", highlight=False, markup=False, soft_wrap=True)

    with terminations_raised(), opened(plan, base, store):
        runners = local(workers) if scheduler is None else cluster(scheduler, say)
        with runners as runner, runs_bar(console) as progress:
            made = run_campaign(store, runner, progress)
        with console.status("summarising"):
            summary = summarise(plan, store)
            files = write_report(summary, store, base)
    if json:
        print_json(summary.document() | {"made": made, "files": [str(file) for file in files]})
    else:
        print_summary(Console(), summary)
        for written in files:
            print(written)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK

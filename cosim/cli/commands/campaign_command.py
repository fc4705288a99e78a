"""``noack campaign``: many runs over a grid of settings."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.cli.execute_campaign import Workers, execute_campaign, worker_pool
from noack.core.errors import ExitStatus

Draws = Annotated[
    int | None,
    typer.Option(help="Runs at each grid point; the campaign file's number by default.", min=1),
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
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    tables: cli.TablesOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario over a grid of settings, with many random draws at each point.

    An interrupted campaign is continued if it is started again with the same folder.

    Exit status 1: a run exceeded a certified bound.
    """
    from cosim.live.progress import PatientConsole
    from cosim.output.figure_format import figure_files
    from cosim.shipped_files import find_shipped
    from cosim.studies.campaign.campaign_file import load
    from cosim.studies.campaign.campaign_report import campaign_tables, print_summary

    start = worker_pool(workers, scheduler)
    files_of_figures = figure_files(figure_format, width)
    console = PatientConsole(stderr=True)
    path = find_shipped(file, "campaigns")
    plan = load(path)
    folder = out or cli.DEFAULT_RUNS / "campaigns" / plan.name
    summary, _, _, made, files = execute_campaign(
        console, plan, path, start, folder=folder, draws=draws, figure_files=files_of_figures
    )
    if json:
        cli.print_json(summary.document() | {"made": made, "files": [str(file) for file in files]})
    else:
        print_summary(cli.console(), summary)
        for written in files:
            print(written)
    cli.write_tables(campaign_tables(summary), tables, json=json)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK

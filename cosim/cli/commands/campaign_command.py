"""``noack campaign``, which makes many runs."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosim.cli import options as opt
from cosim.cli.options import CAMPAIGNS, examples
from cosim.cli.printing import show, write_tables
from cosim.output.figures.figure_format import requested_files
from cosim.record.run_directory import DEFAULT_RUNS
from netem.core.errors import CallerError, ExitStatus

app = typer.Typer()


@app.command(
    rich_help_panel=CAMPAIGNS,
    epilog=examples(
        ("noack campaign mb_vs_zoh", "compare a model with a hold"),
        ("noack campaign mansd_sweep --draws 200 --json", "fewer draws at each grid point"),
        ("noack campaign mb_vs_zoh --scheduler tcp://127.0.0.1:8786", "on a Dask cluster"),
    ),
)
def campaign(
    file: Annotated[
        str,
        Argument(
            autocompletion=opt.complete_campaigns,
            help="Campaign file (TOML), or the name of a shipped campaign.",
        ),
    ],
    draws: Annotated[
        int | None,
        Option(help="Runs at each grid point; the campaign file's number by default."),
    ] = None,
    workers: Annotated[
        int | None, Option(help="Worker processes, at most four per core; one per core by default.")
    ] = None,
    scheduler: Annotated[
        str | None,
        Option(metavar="tcp://HOST:PORT", help="Run on the Dask cluster of this scheduler."),
    ] = None,
    out: Annotated[
        Path | None,
        Option(callback=opt.usable_folder, help="Folder of the campaign; runs/campaigns/NAME by default."),
    ] = None,
    figure_format: opt.FigureFormatOption = None,
    width: opt.WidthOption = None,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Run a scenario over a grid of settings, with many random draws at each point.

    An interrupted campaign is continued if it is started again with the same folder.

    Exit status 1: a run exceeded a certified bound.

    Takes seconds to minutes, by the number of draws.
    """
    from cosim.live.monitoring import progress
    from cosim.shipped_files import find_shipped
    from cosim.studies.campaign import campaign_file, campaign_report
    from cosim.studies.campaign.campaign_workers import Runner, cluster_runner, local_runner, worker_count

    if scheduler is not None and workers is not None:
        raise CallerError("--workers: with --scheduler the cluster's workers are used")
    number = worker_count(workers)
    figure_files = requested_files(figure_format, width)
    path = find_shipped(file, "campaigns")
    plan = campaign_file.load(path)
    if figure_files is not None and not plan.figures:
        raise CallerError(f"--format: there is no figure; {path} has no [[figures]]")
    folder = out or DEFAULT_RUNS / "campaigns" / plan.name
    error_console = progress.error_console()

    def print_line(line: str) -> None:
        error_console.print(f"noack: {line}", highlight=False, markup=False, soft_wrap=True)

    def start() -> AbstractContextManager[Runner]:
        return local_runner(number) if scheduler is None else cluster_runner(scheduler, print_line)

    shown = plan.draws if draws is None else draws
    has_fewer = campaign_report.had_more_draws(folder, shown)
    finished = campaign_report.finish_campaign(
        plan,
        path,
        folder,
        start,
        draws=draws,
        figure_files=figure_files,
        show=progress.activity,
        bar=progress.runs_bar(error_console),
    )
    if has_fewer:
        print_line(
            f"{folder}: page and summary are now those of the first {shown:,} draws; all other runs are "
            "kept, and a larger --draws shows them again"
        )
    summary, files = finished.summary, [str(file) for file in finished.files]
    document = campaign_report.campaign_document(summary)
    show(document, json=json, made=finished.made, files=files)
    if not json:
        print(*files, sep="\n")
    write_tables(document.tables, tables, json=json)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK

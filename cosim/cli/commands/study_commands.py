"""``noack campaign``, which makes many runs."""

from typing import Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.cli.execute_run import Workers, execute_campaign, worker_pool
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from cosim.shipped_files import find_shipped
from noack.core.errors import CallerError, ExitStatus

with lazy_modules():
    from cosim.studies.campaign import campaign_file, campaign_report


@cli.command(cli.CAMPAIGNS, 10, takes="seconds to minutes, by the number of draws")
def campaign(
    file: Annotated[str, typer.Argument(autocompletion=opt.complete_campaigns)],
    *,
    draws: Annotated[int | None, Option(min=1)] = None,
    workers: Workers = None,
    scheduler: Annotated[str | None, Option(metavar="tcp://HOST:PORT")] = None,
    out: opt.OutOption = None,
    figures: opt.FigureOptions,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Run a scenario over a grid of settings, with many random draws at each point.

    An interrupted campaign is continued if it is started again with the same folder.

    Exit status 1: a run exceeded a certified bound.

    Options:
        file: Campaign file (TOML), or the name of a shipped campaign.
        draws: Runs at each grid point; the campaign file's number by default.
        scheduler: Run on the Dask cluster of this scheduler.
        out: Folder of the campaign; runs/campaigns/NAME by default.

    Examples:
        noack campaign mb_vs_zoh   compare a model with a hold
        noack campaign mansd_sweep --draws 200 --json   fewer draws at each grid point
        noack campaign mb_vs_zoh --scheduler tcp://127.0.0.1:8786   on a Dask cluster
    """
    start, figure_files = worker_pool(workers, scheduler), figures.files
    path = find_shipped(file, "campaigns")
    plan = campaign_file.load(path)
    if figure_files is not None and not plan.figures:
        raise CallerError(f"--format: there is no figure; {path} has no [[figures]]")
    folder = out or DEFAULT_RUNS / "campaigns" / plan.name
    summary, _, _, new_runs, files = execute_campaign(
        plan, path, start, folder=folder, draws=draws, figure_files=figure_files
    )
    document = summary.to_json() | {"made": new_runs}
    cli.show_with_files(json, document, files, campaign_report.print_summary, summary)
    cli.write_tables(campaign_report.campaign_tables(summary), tables, json=json)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK

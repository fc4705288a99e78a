"""``noack report``: a run's page of figures and tables."""

from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 90, [
    ("noack report", "the report of the last run"),
    ("noack report --format pdf", "with its figures for a paper"),
    ("noack report runs/latest --json", "print the path as JSON"),
])  # fmt: skip
def report(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    again: Annotated[
        bool, typer.Option("--again", help="Write the report again, even if there is one.")
    ] = False,
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Print the path of a run's report (one HTML page with all figures); write it if missing."""
    from cosim.api.runs import open_run
    from cosim.live.finalize import run_report
    from cosim.output.figure_format import figure_files

    chosen = chosen_run(run_dir, runs)
    figure_files(figure_format, width)  # refuses a wrong width before anything is drawn
    path, figures = run_report(chosen, loop, again=again), []
    if figure_format is not None:
        opened = open_run(chosen)
        shown = opened if loop is None else opened.loops[loop]
        figures = shown.save_figures(figure_format, width)
    if json:
        written = {"figures": [str(one) for one in figures]} if figures else {}
        cli.print_json({"report": str(path)} | written)
    else:
        print(path, *figures, sep="\n")
    return ExitStatus.OK

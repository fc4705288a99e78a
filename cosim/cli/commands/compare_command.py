"""``noack compare``: two or more runs, side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli import command as cli
from cosim.cli import completion
from noack.core.errors import ExitStatus

if TYPE_CHECKING:
    from rich.table import Table


@cli.command(cli.RUNS, 80, [
    ("noack compare runs/A runs/B", "key numbers, and a page with the curves overlaid"),
    ("noack compare runs/A runs/B runs/C --out overlay.png", "the overlay as a picture"),
    ("noack compare runs/A:left runs/A:right", "two loops of a run"),
    ("noack compare runs/A runs/B --json", "as JSON"),
])  # fmt: skip
def compare(
    directories: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...",
            help="Two to seven run directories, live or simulated; RUN:NAME is a loop.",
            autocompletion=completion.run_directories,
        ),
    ],
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="File of the overlay: a page (.html), or a figure (.svg, .png, .pdf, .pgf).",
        ),
    ] = cli.DEFAULT_RUNS / "comparison.html",
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Compare runs: key numbers, settings that differ, curves overlaid."""
    from cosim.live.progress import PatientConsole
    from cosim.studies.run_comparison import compare_runs

    with PatientConsole(stderr=True).status("comparing"):
        found = compare_runs(directories)
        found.save(out, width)
    if json:
        cli.print_json(found.to_json() | {"overlay": str(out)})
        return ExitStatus.OK
    console = cli.console()
    for run in found.runs:
        console.print(f"{run.label}  {run.title}  {run.directory}",
                      markup=False, highlight=False, soft_wrap=True)  # fmt: skip
    labels = [run.label for run in found.runs]
    console.print(_table("key numbers (in brackets: difference to A)", labels, found.rows))
    if found.settings:
        console.print(_table("settings that differ", labels, found.setting_rows))
    console.print(f"overlay: {out}", markup=False, highlight=False, soft_wrap=True)
    return ExitStatus.OK


def _table(title: str, labels: list[str], rows: list[tuple[str, ...]]) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title)
    table.add_column("")
    for label in labels:
        table.add_column(label, justify="right")
    for row in rows:
        table.add_row(*map(escape, row))
    return table

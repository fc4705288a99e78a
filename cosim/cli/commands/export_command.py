"""``noack export``: a run for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.output.export import FORMATS
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


def _known(name: str) -> str:
    if name not in FORMATS:
        raise typer.BadParameter(f"'{name}' is not one of {', '.join(FORMATS)}")
    return name


@cli.command(cli.RUNS, 96, [
    ("noack export --format mat", "the last run for MATLAB and Octave"),
    ("noack export --format mcap --out run.mcap", "for Foxglove and PlotJuggler"),
    ("noack export runs/latest --format csv --json", "a folder of CSV files"),
])  # fmt: skip
def export(
    run_dir: cli.RunArgument = None,
    *,
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            parser=_known,
            metavar="|".join(FORMATS),
            autocompletion=lambda: [*FORMATS],
            help="Format of the file, or of the folder's files.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="File, or folder of CSV; RUN.mat and so on by default."),
    ] = None,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    certificates: Annotated[
        bool,
        typer.Option(
            help="Certificates of each loop in a file of MATLAB; about a second for each loop."
        ),
    ] = True,
    json: cli.JsonOption = False,
) -> int:
    """Export a run for other programs: its tables, its summary and its certificates."""
    from cosim.live.finalize import reopen
    from cosim.live.progress import PatientConsole
    from cosim.output.export import export_run, export_suffix

    chosen = chosen_run(run_dir, runs)
    reopen(chosen)
    name = chosen.resolve().name if loop is None else loop
    path = out or Path(f"{name}{export_suffix(file_format)}")
    with PatientConsole(stderr=True).status("exporting"):
        written = export_run(chosen, path, file_format, loop=loop, certificates=certificates)
    if json:
        cli.print_json({"files": [str(one) for one in written]})
    else:
        print(*written, sep="\n")
    return ExitStatus.OK

"""``noack reproduce``: repeats an archived run, and says what differs."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 94, [
    ("noack reproduce result.noack.zip", "exit status 1 if a bit differs"),
    ("noack reproduce result.noack.zip --into again --json", "keep both runs; print JSON"),
])  # fmt: skip
def reproduce(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Archive of a run.")],
    *,
    run_code: Annotated[
        bool,
        typer.Option(
            "--run-code",
            help="Run the code that the archive contains, if its plant, trigger or controller is "
            "a Python class or an FMU.",
        ),
    ] = False,
    long: Annotated[
        bool,
        typer.Option("--long", help="Repeat a run of more than a million steps, too."),
    ] = False,
    into: Annotated[
        Path | None,
        typer.Option("--into", help="Keep the archived run and its repetition in this new folder."),
    ] = None,
    json: cli.JsonOption = False,
) -> int:
    """Repeat an archived run: simulate it again, or replay its record, bit for bit.

    Versions, machine and numbers that differ are listed. Exit status 1: a bit differs.
    """
    from cosim.live.progress import PatientConsole
    from cosim.studies.run_repetition import print_repetition, repeat_archive

    with PatientConsole(stderr=True).status("repeating"):
        found = repeat_archive(file, run_code=run_code, long=long, into=into)
    if json:
        cli.print_json(found.to_json())
    else:
        print_repetition(cli.console(), found)
    return ExitStatus.OK if found.bit_exact else ExitStatus.FAILED

"""``noack archive``: a run as one file."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 92, [
    ("noack archive", "the last run, as NAME.noack.zip in this folder"),
    ("noack archive runs/latest --out result.noack.zip --json", "to another file"),
])  # fmt: skip
def archive(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="File of the archive; NAME.noack.zip in this folder by default."
        ),
    ] = None,
    json: cli.JsonOption = False,
) -> int:
    """Archive a run: one file with everything that its repetition needs.

    `noack reproduce` repeats it.
    """
    from cosim.live.progress import PatientConsole
    from cosim.studies.run_archive import SUFFIX, write_archive

    chosen = chosen_run(run_dir, runs)
    path = out or Path(f"{chosen.resolve().name}{SUFFIX}")
    with PatientConsole(stderr=True).status("archiving"):
        manifest = write_archive(chosen, path)
    if json:
        cli.print_json({"archive": str(path)} | manifest.model_dump(mode="json"))
    else:
        print(path)
    return ExitStatus.OK

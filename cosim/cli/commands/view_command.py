"""``noack view``: a run's recording in the rerun viewer."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.record.run_directory import RECORDING_FILE, SCENARIO_FILE, chosen_run, file_of_loop
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 40, [
    ("noack view", "the last run, in a window if there is a display"),
    ("noack view runs/latest --web", "in a browser on this machine"),
    ("noack view --loop pendulum-07", "one loop of a run of several, in detail"),
])  # fmt: skip
def view(
    recording: Annotated[
        Path | None,
        typer.Argument(
            help="Run directory or .rrd file; the last run by default.",
            autocompletion=completion.run_directories,
        ),
    ] = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    web: Annotated[
        bool, typer.Option("--web", help="Show it in a browser on this machine.")
    ] = False,
    json: cli.JsonOption = False,
) -> int:
    """Show a run in the rerun viewer.

    A missing recording, as that of one loop alone, is written first.
    """
    from cosim.output.viewer.live_viewer import view_recording

    path = chosen_run(recording, runs)
    path = path / file_of_loop(RECORDING_FILE, loop) if path.is_dir() else path
    if (path.parent / SCENARIO_FILE).is_file() and not path.is_file():
        _write(path.parent, loop)
    if json:
        cli.print_json({"recording": str(path), "exists": path.is_file()})
        return ExitStatus.OK if path.is_file() else ExitStatus.CALLER
    view_recording(path, native=False if web else None)
    return ExitStatus.OK


def _write(run_dir: Path, loop: str | None) -> None:
    from cosim.live.finalize import write_recording
    from cosim.live.progress import PatientConsole

    with PatientConsole(stderr=True).status("writing the recording"):
        write_recording(run_dir, loop)

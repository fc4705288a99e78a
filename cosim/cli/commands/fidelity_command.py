"""``noack fidelity``: a run compared with the ideal loop."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 60, [
    ("noack fidelity", "effects of sampling, delay and hold on the last run"),
    ("noack fidelity --out fidelity.png", "with a figure"),
    ("noack fidelity runs/latest --json", "as JSON"),
])  # fmt: skip
def fidelity(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Write a figure of the differences over time (.svg, .png, .pdf).",
        ),
    ] = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Compare a run with the ideal loop in continuous time, effect by effect."""
    from cosim.analysis.fidelity import compute_fidelity
    from cosim.live.progress import PatientConsole
    from cosim.output.figure_files import save_figure
    from cosim.output.run_verdict import print_fidelity
    from cosim.output.signal_figures import fidelity_figure
    from cosim.record.run_record import load_record

    path = chosen_run(run_dir, runs)
    with PatientConsole(stderr=True).status("comparing"):
        found = compute_fidelity(load_record(path, loop))
        if out is not None:
            save_figure(fidelity_figure(found), out, width)
    if json:
        cli.print_json(found.as_json())
    else:
        print_fidelity(cli.console(), found)
    return ExitStatus.OK if found.explained else ExitStatus.FAILED

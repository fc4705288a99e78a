"""``noack collect``: adds what processes on other hosts kept of a run to its record."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 55, [
    ("noack collect runs/latest robot:noack/runs/RUN", "by scp from the host robot"),
    ("noack collect runs/latest copy", "from a folder that was copied here"),
])  # fmt: skip
def collect(
    run_dir: Annotated[Path, typer.Argument(help="Run directory.")],
    sources: Annotated[
        list[str],
        typer.Argument(help="Folders named by the processes: FOLDER, or HOST:FOLDER for scp."),
    ],
    *,
    json: cli.JsonOption = False,
) -> int:
    """Add what processes on other hosts kept of a run, and finalise it again.

    A process that was invited keeps its rows on its host when the recorder is out of reach at the
    end. It then prints their folder.
    """
    from cosim.live.finalize import reopen
    from cosim.output.run_verdict import print_outcome
    from cosim.record import collection
    from cosim.record.run_directory import chosen_run
    from noack.runtime.command_line import print_to_stderr

    run_dir = chosen_run(run_dir, cli.DEFAULT_RUNS)
    outcome = reopen(run_dir)  # refuses a run that is under way
    for source in sources:
        merged, roles = collection.collect(run_dir, source, reopen)
        outcome = replace(merged, run_dir=run_dir)
        print_to_stderr(f"noack: {source}: took what {', '.join(roles) or 'no process'} kept")
    if json:
        cli.print_json(outcome.summary.to_json())
    else:
        print_outcome(cli.console(), outcome)
    return ExitStatus.OK

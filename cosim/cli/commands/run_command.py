"""``noack run``: a live run."""

import typer

from cosim.cli import command as cli
from cosim.cli.execute_run import RunOutput, run_processes


@cli.command(cli.RUNS, 20, [
    ("noack run lane_following", "the paper's example, 20 s"),
    ("noack run unstable_pendulum --set horizon_s=5 --live", "5 s, with the live viewer"),
    ("noack run lane_following --set network.mansd=9 --json", "M − 1 = 9; print JSON"),
])  # fmt: skip
def run(
    context: typer.Context,
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    live: cli.LiveOption = False,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario live: start all processes and record everything."""
    output = RunOutput(report, verbose, json)
    return run_processes(
        lambda: cli.load_scenario(scenario, settings), runs, output,
        live=live, server=context.obj,
    )  # fmt: skip

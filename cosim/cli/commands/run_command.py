"""``noack run``: a live run."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.cli.execute_run import RunOutput, run_processes


@cli.command(cli.RUNS, 20, [
    ("noack run lane_following", "the paper's example, 20 s"),
    ("noack run unstable_pendulum --set horizon_s=5 --live", "5 s, with the live viewer"),
    ("noack run lane_following --set network.mansd=9 --json", "M − 1 = 9; print JSON"),
    ("noack run lane_following --hosts hosts.toml", "some processes on other hosts, over ssh"),
])  # fmt: skip
def run(
    context: typer.Context,
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    live: cli.LiveOption = False,
    metrics: cli.MetricsOption = None,
    _log_format: cli.LogFormatOption = cli.LogFormat.TEXT,
    hosts: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="TOML file that places processes on other hosts."),
    ] = None,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario live: start all processes and record everything."""
    output, listening = RunOutput(report, verbose, json), None
    if hosts is not None:
        from cosim.live.remote_access import listening_for

        listening = listening_for(hosts)
    return run_processes(
        lambda: cli.load_scenario(scenario, settings), runs, output,
        live=live, server=context.obj, metrics=metrics, listening=listening,
    )  # fmt: skip

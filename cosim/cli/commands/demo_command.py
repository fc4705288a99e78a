"""``noack demo``: the paper's example, live."""

from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.cli.execute_run import RunOutput, run_processes


@cli.command(cli.RUNS, 10, [
    ("noack demo", "20 s; the record is in runs/latest"),
    ("noack demo --zoh --live", "zero-order hold, with the live viewer"),
    ("noack demo --set speed=4 --set horizon_s=8", "takes 2 s of wall time"),
])  # fmt: skip
def demo(
    context: typer.Context,
    *,
    zoh: Annotated[
        bool, typer.Option("--zoh", help="Hold the last update (ZOH) instead of using a model.")
    ] = False,
    settings: cli.SetOption = None,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    live: cli.LiveOption = False,
    metrics: cli.MetricsOption = None,
    _log_format: cli.LogFormatOption = cli.LogFormat.TEXT,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Run the paper's lane-following example live."""
    wanted = [*(['mode="zoh"'] if zoh else []), *(settings or ())]
    output = RunOutput(report, verbose, json)
    return run_processes(
        lambda: cli.load_scenario("lane_following", wanted), runs, output,
        live=live, server=context.obj, metrics=metrics,
    )  # fmt: skip

"""``noack demo``: the paper's example, live."""

from typing import Annotated

import typer

from cosim.cli.command import (
    RUNS,
    JsonOption,
    LiveOption,
    ReportOption,
    RunsOption,
    SetOption,
    VerboseOption,
    command,
    find_scenario,
)
from cosim.cli.execute_run import RunOutput, run_processes
from cosim.record.run_directory import DEFAULT_RUNS
from noack.config.scenario_file import load
from noack.protocol.topology import ROLES


@command(RUNS, 10, [
    ("noack demo", "20 s; the record is in runs/latest"),
    ("noack demo --zoh --live", "zero-order hold, with the live viewer"),
    ("noack demo --set speed=4 --set horizon_s=8", "takes 2 s of wall time"),
])  # fmt: skip
def demo(
    *,
    zoh: Annotated[
        bool, typer.Option("--zoh", help="Hold the last update (ZOH) instead of using a model.")
    ] = False,
    settings: SetOption = None,
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    report: ReportOption = True,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> int:
    """Run the paper's lane-following example live."""
    mode = ['mode="zoh"'] if zoh else []
    loaded = load(find_scenario("lane_following"), [*mode, *(settings or ())])
    return run_processes(loaded, runs, RunOutput(report, verbose, json), spawn=ROLES, live=live)

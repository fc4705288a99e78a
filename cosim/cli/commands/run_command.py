"""``noack run``: a live run."""

from cosim.cli.command import (
    RUNS,
    JsonOption,
    LiveOption,
    ReportOption,
    RunsOption,
    ScenarioArgument,
    SetOption,
    VerboseOption,
    command,
    find_scenario,
)
from cosim.cli.execute_run import RunOutput, run_processes
from cosim.record.run_directory import DEFAULT_RUNS
from noack.config.scenario_file import load
from noack.protocol.topology import ROLES


@command(RUNS, 20, [
    ("noack run lane_following", "the paper's example, 20 s"),
    ("noack run unstable_pendulum --set horizon_s=5 --live", "5 s, with the live viewer"),
    ("noack run lane_following --set network.mansd=9 --json", "print the summary as JSON"),
])  # fmt: skip
def run(
    scenario: ScenarioArgument,
    *,
    settings: SetOption = None,
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    report: ReportOption = True,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> int:
    """Run a scenario live: start all processes and record everything."""
    loaded = load(find_scenario(scenario), settings or ())
    return run_processes(loaded, runs, RunOutput(report, verbose, json), spawn=ROLES, live=live)

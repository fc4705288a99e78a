"""``noack simulate``: a run in virtual time."""

from enum import StrEnum
from typing import Annotated

import typer
from rich.console import Console

from cosim.cli import command as cli
from cosim.cli.execute_run import RunOutput, finalize_run, warn_of_violations
from noack.config.scenario import Scenario
from noack.core.errors import ExitStatus


class TriggerMode(StrEnum):
    """When a simulated sensor compares its error with the threshold."""

    SAMPLED = "sampled"
    CONTINUOUS = "continuous"


@cli.command(cli.RUNS, 30, [
    ("noack simulate lane_following", "the processes of a live run, without sockets"),
    ("noack simulate lane_following --trigger continuous", "the paper's loop, exactly"),
    ("noack simulate reactor_petc --no-report --json", "print the summary as JSON"),
])  # fmt: skip
def simulate(
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    trigger: Annotated[
        TriggerMode,
        typer.Option(
            help="sampled: test the trigger at each measurement, as in a live run; "
            "continuous: at all times."
        ),
    ] = TriggerMode.SAMPLED,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario in virtual time: no sockets, no deadlines missed.

    The trigger, the losses and the controller are those of a live run.
    """
    loaded = cli.load_scenario(scenario, settings)
    warn_of_violations(loaded)
    if trigger is TriggerMode.CONTINUOUS:
        return _simulate_continuously(loaded, json=json)
    from cosim.live.progress import PatientConsole, simulation_bar
    from cosim.live.simulated_run import simulate_run

    with simulation_bar(PatientConsole(stderr=True), loaded.horizon_s) as progress:
        ending = simulate_run(loaded, runs, progress=progress)
    return finalize_run(ending, RunOutput(report, verbose, json))


def _simulate_continuously(scenario: Scenario, *, json: bool) -> int:
    from cosim.live.progress import PatientConsole
    from cosim.output.continuous_table import print_run
    from cosim.simulation.continuous.continuous_report import document, run_continuous, summary
    from noack.config.resolution import resolve

    resolved = resolve(scenario)
    with PatientConsole(stderr=True).status("simulating"):
        run = run_continuous(resolved)
    if json:
        cli.print_json(document(run, resolved))
    else:
        print_run(Console(), run, resolved)
    return ExitStatus(summary(run, resolved)["exit"]["status"])

"""``noack doctor``: what this machine permits, and whether that suffices for a run."""

from typing import Annotated

import typer

from cosim.cli import command as cli
from cosim.cli.completion import scenarios
from noack.core.errors import ExitStatus


@cli.command(cli.FILES, 10, [
    ("noack doctor", "for the paper's example"),
    ("noack doctor lane_weighted --set speed=4", "for another scenario"),
    ("noack doctor --seconds 10 --json", "measure longer; all numbers as JSON"),
])  # fmt: skip
def doctor(
    scenario: Annotated[
        str,
        typer.Argument(
            help="Scenario file or shipped scenario, for its rates, ports and allowed lateness.",
            autocompletion=scenarios,
        ),
    ] = "lane_following",
    *,
    settings: cli.SetOption = None,
    seconds: Annotated[
        float,
        typer.Option(
            help="Seconds of each measurement of wake-ups: without and with real-time settings.",
            min=0.1,
            max=3600,
        ),
    ] = 2.0,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    json: cli.JsonOption = False,
) -> int:
    """Check this machine: real-time settings, timers, ports, disk.

    Each finding is good, limited or bad, with its meaning for a run and a remedy.

    Exit status 1: a finding is bad, so that no run is possible.
    """
    from cosim.doctor.findings import FindingStatus, document, judge, print_findings, worst
    from cosim.doctor.machine_facts import requirements_of
    from cosim.doctor.machine_measures import measure
    from cosim.live.progress import PatientConsole
    from noack.config.resolution import resolve

    resolved = resolve(cli.load_scenario(scenario, settings))
    wanted = requirements_of(resolved)
    with PatientConsole(stderr=True).status("measuring"):
        machine = measure(resolved, wanted, runs, seconds)
    findings = judge(machine, wanted)
    if json:
        cli.print_json(document(machine, wanted, findings))
    else:
        print_findings(cli.console(), wanted, findings)
    return ExitStatus.FAILED if worst(findings) is FindingStatus.BAD else ExitStatus.OK

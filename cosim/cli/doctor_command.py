"""The command that says what this machine grants."""

from typing import Annotated

import typer
from rich.console import Console

from cosim.cli.command import (
    FILES,
    JsonOption,
    RunsOption,
    SetOption,
    command,
    find_scenario,
    print_json,
)
from cosim.cli.completion import scenarios
from cosim.record.run_directory import DEFAULT_RUNS
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus


@command(FILES, [
    ("noack doctor", "for the paper's example"),
    ("noack doctor lane_weighted --set speed=4", "for a run of one's own"),
    ("noack doctor --seconds 10 --json", "longer, with all numbers"),
])  # fmt: skip
def doctor(
    scenario: Annotated[
        str,
        typer.Argument(
            help="The scenario whose rates, ports and allowances count: a file, or the name of a "
            "shipped one.",
            autocompletion=scenarios,
        ),
    ] = "lane_following",
    settings: SetOption = None,
    seconds: Annotated[
        float, typer.Option(help="How long wake-ups are watched, each way.", min=0.1, max=3600)
    ] = 2.0,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Say what this machine grants, and what that means for a run; 1 if none is possible.

    Real-time settings, timers and wake-ups, cores, sockets, ports, the disk, the viewer and
    extras: each is good, limited or bad, with what would be better.
    """
    from cosim.doctor.doctor_table import document, print_findings
    from cosim.doctor.findings import FindingStatus, judge, worst
    from cosim.doctor.machine_facts import requirements_of
    from cosim.doctor.machine_measures import measure
    from cosim.live.progress import PatientConsole
    from noack.config.resolution import resolve

    resolved = resolve(load(find_scenario(scenario), settings or ()))
    wanted = requirements_of(resolved)
    with PatientConsole(stderr=True).status("measuring"):
        machine = measure(resolved, wanted, runs, seconds)
    findings = judge(machine, wanted)
    if json:
        print_json(document(machine, wanted, findings))
    else:
        print_findings(Console(), wanted, findings)
    return ExitStatus.FAILED if worst(findings) is FindingStatus.BAD else ExitStatus.OK

"""The command that says what this machine grants."""

from typing import Annotated

import typer
from rich.console import Console

from cosim.cli.app import (
    FILES,
    JsonOption,
    RunsOption,
    SetOption,
    command,
    find_scenario,
    print_json,
)
from cosim.cli.complete import scenarios
from cosim.run_dir import DEFAULT_RUNS
from noack.errors import ExitStatus
from noack.scenario_file import load


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
    from cosim.doctor.facts import wanted_of
    from cosim.doctor.judge import Verdict, judge, worst
    from cosim.doctor.measure import measure
    from cosim.doctor.table import document, print_findings
    from cosim.progress import PatientConsole
    from noack.resolve import resolve

    resolved = resolve(load(find_scenario(scenario), settings or ()))
    wanted = wanted_of(resolved)
    with PatientConsole(stderr=True).status("measuring"):
        machine = measure(resolved, wanted, runs, seconds)
    findings = judge(machine, wanted)
    if json:
        print_json(document(machine, wanted, findings))
    else:
        print_findings(Console(), wanted, findings)
    return ExitStatus.FAILED if worst(findings) is Verdict.BAD else ExitStatus.OK

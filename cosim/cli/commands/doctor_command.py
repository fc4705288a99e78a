"""``noack doctor``: check this machine."""

from typing import Annotated

import typer
from typer import Option

from cosim.cli import options as opt
from cosim.cli.options import FILES, examples
from cosim.cli.printing import show, status
from cosim.record.run_directory import DEFAULT_RUNS
from netem.core.errors import ExitStatus

app = typer.Typer()


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack doctor", "for the paper's example"),
        ("noack doctor lane_weighted --set speed=4", "for another scenario"),
        ("noack doctor --seconds 10 --json", "measure longer; all numbers as JSON"),
    ),
)
def doctor(
    scenario: opt.ScenarioArgument = "lane_following",
    settings: opt.SetOption = None,
    seconds: Annotated[
        float,
        Option(
            min=0.1,
            max=3600,
            help="Seconds of the measurement of wake-ups.",
        ),
    ] = 2.0,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Check this machine: real-time settings, lateness, ports, disk.

    Each finding is good, limited or bad, with its meaning for a run and a remedy. The scenario
    determines rates, ports and the allowed lateness.

    Exit status 1: a finding is bad, so that no run is possible.

    Takes some 5 s.
    """
    opt.require_linux()
    from cosim.doctor import findings
    from cosim.doctor.machine_measures import measure, requirements_of
    from noack.scenario.resolution import resolve

    resolved = resolve(opt.load_scenario(scenario, settings))
    required = requirements_of(resolved)
    with status("measuring"):
        machine = measure(resolved, required, runs, seconds)
    results = findings.find_all(machine, required)
    show(findings.findings_document(machine, required, results), json=json)
    is_bad = findings.worst(results) is findings.MachineVerdict.BAD
    return ExitStatus.FAILED if is_bad else ExitStatus.OK

"""``noack doctor``, ``lab``: this machine, and the page for experiments."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from typer import Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError, ExitStatus

with lazy_modules():
    from cosim.doctor import findings, machine_measures
    from cosim.interactive import draft
    from cosim.lab import lab_server
    from noack.scenario import resolution, scenario_file


@cli.command(cli.FILES, 10, takes="some 10 s", on_linux=True)
def doctor(
    source: opt.ExampleOptions,
    *,
    seconds: Annotated[float, Option(min=0.1, max=3600)] = 2.0,
    runs: opt.RunsOption = cli.DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Check this machine: real-time settings, timers, ports, disk.

    Each finding is good, limited or bad, with its meaning for a run and a remedy. The scenario
    determines rates, ports and the allowed lateness.

    Exit status 1: a finding is bad, so that no run is possible.

    Options:
        seconds: Seconds of each measurement of wake-ups: without and with real-time settings.

    Examples:
        noack doctor   for the paper's example
        noack doctor lane_weighted --set speed=4   for another scenario
        noack doctor --seconds 10 --json   measure longer; all numbers as JSON
    """
    resolved = resolution.resolve(source.load())
    required = machine_measures.requirements_of(resolved)
    with cli.status("measuring"):
        machine = machine_measures.measure(resolved, required, runs, seconds)
    results = findings.judge(machine, required)
    cli.show(
        json,
        lambda: findings.document(machine, required, results),
        findings.print_findings,
        required,
        results,
    )
    is_bad = findings.worst(results) is findings.FindingStatus.BAD
    return ExitStatus.FAILED if is_bad else ExitStatus.OK


@cli.command(cli.RUNS, 5, on_linux=True)
def lab(
    source: opt.ExampleOptions,
    *,
    runs: opt.RunsOption = cli.DEFAULT_RUNS,
    port: Annotated[int, Option(min=0, max=65535)] = 0,
    browser: bool = True,
    json: opt.JsonOption = False,
) -> None:
    """Open a page in the browser: drag settings, watch the loop, run it live.

    The page is on 127.0.0.1, at an address with a secret. Ctrl-C ends it.

    Options:
        port: Port on 127.0.0.1; 0: a free one.
        browser: Open the page in a browser.

    Examples:
        noack lab   open the paper's example
        noack lab mine.toml --set trigger.beta=0.3   open a file with other settings
        noack lab --no-browser --port 8080   print the address, for a browser elsewhere
    """
    if find_spec("nicegui") is None:
        raise CallerError(
            "the page needs the extra `lab`: pip install 'noack[lab]', or `make lab` in the repository"
        )
    edited = draft.open_draft(source.scenario)
    for key, value in map(scenario_file.setting_of, source.settings or ()):
        edited = edited.with_value(key, value)
    _ = edited.scenario  # report mistakes here
    query = edited.query() if source.settings else ""
    options = lab_server.LabOptions(source.scenario, query, Path.cwd(), runs, port, browser)

    def announce(address: str) -> None:
        cli.print_lines(json, {"address": address}, f"noack lab: {address}  (Ctrl-C ends)")
        sys.stdout.flush()  # somebody waits for it

    lab_server.serve(options, announce)

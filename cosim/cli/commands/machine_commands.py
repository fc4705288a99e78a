"""``noack doctor``, ``lab``: this machine, and the page for experiments."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from typer import Option

from cosim.cli import command as cli
from noack.core.errors import CallerError, ExitStatus


@cli.command(cli.FILES, 10, [
    ("noack doctor", "for the paper's example"),
    ("noack doctor lane_weighted --set speed=4", "for another scenario"),
    ("noack doctor --seconds 10 --json", "measure longer; all numbers as JSON"),
])  # fmt: skip
def doctor(
    scenario: cli.ScenarioArgument = "lane_following",
    *,
    settings: cli.SetOption = None,
    seconds: Annotated[float, Option(min=0.1, max=3600)] = 2.0,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    json: cli.JsonOption = False,
) -> int:
    """Check this machine: real-time settings, timers, ports, disk.

    Each finding is good, limited or bad, with its meaning for a run and a remedy.

    Exit status 1: a finding is bad, so that no run is possible.

    Options:
        scenario: Scenario file or shipped scenario, for its rates, ports and allowed lateness.
        seconds: Seconds of each measurement of wake-ups: without and with real-time settings.
    """
    from cosim.doctor.findings import FindingStatus, document, judge, print_findings, worst
    from cosim.doctor.machine_measures import measure, requirements_of
    from noack.config.resolution import resolve

    resolved = resolve(cli.load_scenario(scenario, settings))
    wanted = requirements_of(resolved)
    with cli.status("measuring"):
        machine = measure(resolved, wanted, runs, seconds)
    findings = judge(machine, wanted)
    cli.show(json, lambda: document(machine, wanted, findings), print_findings, wanted, findings)
    return ExitStatus.FAILED if worst(findings) is FindingStatus.BAD else ExitStatus.OK


@cli.command(cli.RUNS, 5, [
    ("noack lab", "open the paper's example"),
    ("noack lab mine.toml --set trigger.beta=0.3", "open a file with other settings"),
    ("noack lab --no-browser --port 8080", "print the address, for a browser elsewhere"),
])  # fmt: skip
def lab(
    scenario: cli.ScenarioArgument = "lane_following",
    *,
    settings: cli.SetOption = None,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    port: Annotated[int, Option(min=0, max=65535)] = 0,
    browser: bool = True,
    json: cli.JsonOption = False,
) -> int:
    """Open a page in the browser: drag settings, watch the loop, run it live.

    The page is on 127.0.0.1, at an address with a secret. Ctrl-C ends it.

    Options:
        port: Port on 127.0.0.1; 0: a free one.
        browser: Open the page in a browser.
    """
    if find_spec("nicegui") is None:
        raise CallerError(
            "the page needs the extra `lab`: pip install 'noack[lab]', or `make lab` in the "
            "repository"
        )
    from cosim.interactive.draft import open_draft
    from cosim.lab.lab_server import LabOptions, serve
    from noack.config.scenario_file import value_of

    draft = open_draft(scenario)
    for setting in settings or ():
        key, equals, text = setting.partition("=")
        if not equals:
            raise CallerError(f"--set {setting}: write it as key=value, e.g. trigger.beta=0.3")
        draft = draft.with_value(key.strip(), value_of(text, f"--set {key}"))
    _ = draft.scenario  # report mistakes here
    query = draft.query() if settings else ""
    options = LabOptions(scenario, query, Path.cwd(), runs, port, browser)

    def announce(address: str) -> None:
        if json:
            cli.print_json({"address": address})
        else:
            print(f"noack lab: {address}  (Ctrl-C ends)")
        sys.stdout.flush()  # somebody waits for it

    serve(options, announce)
    return ExitStatus.OK

"""``noack lab``: a page for trying settings, running live and opening runs."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import CallerError, ExitStatus


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
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0: a free one.")
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
    json: cli.JsonOption = False,
) -> int:
    """Open a page in the browser: drag settings, watch the loop, run it live.

    The page is on 127.0.0.1, at an address with a secret. Ctrl-C ends it.
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

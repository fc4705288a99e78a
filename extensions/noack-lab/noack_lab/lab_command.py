"""The command ``noack lab``."""

import json as json_format
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

app = typer.Typer()


@app.command(
    rich_help_panel="Runs",
    epilog="""Examples:

- `noack lab` – open the paper's example
- `noack lab mine.toml --set trigger.beta=0.3` – open a file with other settings
- `noack lab --no-browser --port 8080` – print the address, for a browser elsewhere""",
)
def lab(
    scenario: Annotated[
        str, Argument(help="Scenario file (TOML), or the name of a shipped scenario.")
    ] = "lane_following",
    settings: Annotated[
        list[str] | None,
        Option("--set", metavar="KEY=VALUE", help="Replace a value of the scenario, e.g. trigger.beta=0.3."),
    ] = None,
    runs: Annotated[Path, Option(help="Folder of the run directories.")] = Path("runs"),
    port: Annotated[int, Option(min=0, max=65535, help="Port on 127.0.0.1; 0: a free one.")] = 0,
    browser: Annotated[bool, Option(help="Open the page in a browser.")] = True,
    json: Annotated[
        bool, Option("--json", help="Print one JSON document on stdout, and nothing else.")
    ] = False,
) -> None:
    """Open a page in the browser: drag settings, watch the loop, run it live.

    The page is on 127.0.0.1, at an address with a secret. Ctrl-C ends it.
    """
    from noack_lab.lab_server import serve  # imports nicegui
    from noack_lab.scenario_draft import open_draft, setting

    draft, runs = open_draft(scenario), runs.absolute()
    for key, value in map(setting, settings or ()):
        draft = draft.with_value(key, value)
    if Path(scenario).is_file():
        os.chdir(Path(scenario).absolute().parent)  # relative names in the text are relative to it
    _ = draft.scenario  # report mistakes here

    def announce(address: str) -> None:
        text = f"noack lab: {address}  (Ctrl-C ends)"
        print(json_format.dumps({"address": address}) if json else text)
        sys.stdout.flush()  # somebody waits for it

    serve(draft, runs, port, announce, open_browser=browser)

"""The command ``noack bridge``; it imports within its function, since each command reads this file."""

import json as json_format
import tomllib
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

app = typer.Typer()


def _setting(text: str) -> tuple[str, object]:
    """Return key and value of ``--set``; a value that is not TOML is a text."""
    key, equals, value = text.partition("=")
    if not equals:
        raise typer.BadParameter(f"{text}: write KEY=VALUE, e.g. trigger.beta=0.3", param_hint="--set")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value


@app.command(
    rich_help_panel="Runs",
    epilog="""Examples:

- `noack bridge lane_following --listen` – without an installation of ROS
- `noack bridge lane_following --router tcp/127.0.0.1:7447 --json` – with rmw_zenohd""",
)
def bridge(
    scenario: Annotated[str, Argument(help="Scenario file (TOML), or the name of a shipped scenario.")],
    settings: Annotated[
        list[str] | None,
        Option("--set", metavar="KEY=VALUE", help="Replace a value of the scenario, e.g. trigger.beta=0.3."),
    ] = None,
    router: Annotated[
        str, Option(metavar="ENDPOINT", help="Where the router of ROS 2 listens, as zenoh writes it.")
    ] = "tcp/127.0.0.1:7447",
    listen: Annotated[
        bool, Option("--listen", help="Be the router at this address, to which nodes connect.")
    ] = False,
    domain: Annotated[int, Option(min=0, max=232, help="ROS_DOMAIN_ID.")] = 0,
    runs: Annotated[Path, Option(help="Folder of the run directories.")] = Path("runs"),
    json: Annotated[
        bool, Option("--json", help="Print one JSON document on stdout, and nothing else.")
    ] = False,
) -> int:
    """Run a scenario live, and publish it as topics of ROS 2 (rmw_zenoh).

    Takes as long as the scenario's horizon, and a few seconds.
    """
    import noack
    from noack_ros2.bridge import bridge_process

    loaded = noack.load(scenario, dict(map(_setting, settings or ())))
    with bridge_process(router, domain, listen=listen) as observer:
        run = noack.run(loaded, runs=runs, progress=True, observers=[observer])
    print(json_format.dumps(run.summary.to_json()) if json else run)
    return 0 if run.ok else 1

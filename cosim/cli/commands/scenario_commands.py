"""``noack scenarios``, ``check``, ``schema``: scenario files."""

from collections.abc import Sequence
from typing import Annotated

import typer
from typer import Argument, Option

from cosim.cli import options as opt
from cosim.cli.options import FILES, examples
from cosim.cli.printing import console, print_json
from cosim.shipped_files import KINDS, ShippedFile, all_shipped, text_of

app = typer.Typer()


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack scenarios", "list them all"),
        ("noack scenarios unstable_pendulum > mine.toml", "copy one, to make it your own"),
        ("noack scenarios --json", "list them as JSON"),
    ),
)
def scenarios(
    name: Annotated[
        str | None,
        Argument(autocompletion=opt.complete_shipped, help="Print this scenario or campaign."),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """List the shipped scenarios and campaigns, or print one of them."""
    if name is not None:
        text = text_of(name)
        print_json({"name": name, "toml": text}) if json else print(text, end="")
        return
    shipped = {kind: all_shipped(kind) for kind in KINDS}
    if json:
        print_json(
            {
                kind: [file._asdict() | {"path": str(file.path)} for file in files]
                for kind, files in shipped.items()
            }
        )
        return
    for kind, files in shipped.items():
        console().print(kind, style="bold", highlight=False)
        _print_shipped(files)


def _print_shipped(files: Sequence[ShippedFile]) -> None:
    """Print one line per file to a pipe, or a wrapped table to a terminal."""
    from rich.table import Table

    width = max(len(file.name) for file in files)
    if not console().is_terminal:
        for file in files:
            print(f"{file.name:{width}}  {file.description}")
        return
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=width, no_wrap=True, style="cyan")
    table.add_column()
    for file in files:
        table.add_row(file.name, file.description)
    console().print(table)


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack check lane_following", "print the scenario and its assumptions"),
        ("noack check lane_following --set mode=zoh --json", "as JSON"),
        ("noack check shared_channel --resolved --loop lane-1", "one loop, in numbers only"),
        ("noack check lane_following --document", "what its bounds are proven of, in words"),
    ),
)
def check(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
    resolved: Annotated[
        bool, Option("--resolved", help="Print one loop with numbers only, also for times that have none.")
    ] = False,
    document: Annotated[
        bool,
        Option(
            "--document",
            help="Print in words what the bounds are proven of: the loop document; "
            "`noack certify NAME` searches the proof.",
        ),
    ] = False,
    loop: opt.LoopOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Check a scenario and print it with all defaults and random draws filled in.

    The output is a scenario file. Comments at its end say which assumptions hold.

    A nonlinear plant is also started and linearised. For a plant in Python this runs its code.
    """
    from cosim.cli.scenario_check import check_scenario, print_document, print_resolved

    loaded = opt.load_loop(scenario, settings, loop, network)
    if document:
        print_document(loaded, json=json)
    elif resolved:
        print_resolved(loaded, json=json)
    else:
        check_scenario(loaded, json=json)


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack schema > scenario.schema.json", "for an editor that completes keys"),
        ("noack schema --campaign", "the schema of campaign files"),
        ("noack schema --netem", "the schema of the emulator's links files"),
    ),
)
def schema(
    netem: Annotated[bool, Option("--netem", help="Print the schema of the emulator's links files.")] = False,
    campaign: Annotated[bool, Option("--campaign", help="Print the schema of campaign files.")] = False,
    json: opt.JsonOption = False,
) -> None:
    """Print the JSON Schema of scenario files, for editors."""
    if campaign:
        from cosim.studies.campaign.campaign_file import json_schema as campaign_schema

        print_json(campaign_schema())
    elif netem:
        from netem.links_file import json_schema as links_schema

        print_json(links_schema())
    else:
        from netem.core.toml_file import json_schema
        from noack.scenario.scenario import Scenario

        print_json(json_schema(Scenario))

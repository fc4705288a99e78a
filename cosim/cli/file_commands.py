"""Commands on scenario files."""

from collections.abc import Iterator, Sequence
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from cosim.cli import completion
from cosim.cli.command import (
    FILES,
    JsonOption,
    ScenarioArgument,
    SetOption,
    command,
    find_scenario,
    print_json,
)
from cosim.shipped_files import KINDS, ShippedFile, all_shipped, text_of
from noack.config.scenario import Scenario
from noack.config.scenario_file import dumps as scenario_toml
from noack.config.scenario_file import json_schema, load
from noack.core.clock import NS_PER_S
from noack.core.errors import ExitStatus

_COMMENT = "# "


@command(FILES, [
    ("noack scenarios", "all of them, and what each is"),
    ("noack scenarios unstable_pendulum > mine.toml", "a file to change into your own"),
    ("noack scenarios --json", ""),
])  # fmt: skip
def scenarios(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Print this one, scenario or campaign, instead.", autocompletion=completion.shipped
        ),
    ] = None,
    json: JsonOption = False,
) -> int:
    """List the scenarios and campaigns that come with noack; or print one, to start from."""
    if name is not None:
        text = text_of(name)
        print_json({"name": name, "toml": text}) if json else print(text, end="")
        return ExitStatus.OK
    shipped = {kind: all_shipped(kind) for kind in KINDS}
    if json:
        print_json({
            kind: [one._asdict() | {"path": str(one.path)} for one in some]
            for kind, some in shipped.items()
        })  # fmt: skip
        return ExitStatus.OK
    console = Console()
    for kind, some in shipped.items():
        console.print(kind, style="bold", highlight=False)
        _print_shipped(console, some)
    return ExitStatus.OK


def _print_shipped(console: Console, some: Sequence[ShippedFile]) -> None:
    """A line each where a program reads, wrapped beside their names where a person does."""
    width = max(len(one.name) for one in some)
    if not console.is_terminal:
        for one in some:
            print(f"{one.name:{width}}  {one.description}")
        return
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=width, no_wrap=True, style="cyan")
    table.add_column()
    for one in some:
        table.add_row(one.name, one.description)
    console.print(table)


@command(FILES, [
    ("noack check lane_following", "all its keys, and what the paper assumes"),
    ("noack check lane_following --set mode=zoh --json", ""),
])  # fmt: skip
def check(scenario: ScenarioArgument, settings: SetOption = None, json: JsonOption = False) -> int:
    """Check a scenario and print it resolved: defaults, named models and draws made explicit.

    What it assumes follows as comments, so that the output is a scenario file.

    A plant that is not linear is made, and what it is said; with one of the user's own that runs
    its code.
    """
    from cosim.output.assumptions_table import print_assumptions
    from noack.config.resolution import resolve
    from noack.theory.assumptions import assumptions
    from noack.trigger.policy_from_settings import policy_of

    resolved = resolve(load(find_scenario(scenario), settings or ()))
    policy_of(resolved)  # some need a stable loop
    verdicts = [assumption._asdict() for assumption in assumptions(resolved)]
    console = Console()
    console.width -= len(_COMMENT)
    with console.capture() as captured:  # before anything is printed: the plant may be refused
        console.print("the paper's assumptions, for this scenario:")
        print_assumptions(console, verdicts)
        _print_plant(console, resolved)
    if json:
        print_json(resolved.model_dump(mode="json"))
        return ExitStatus.OK
    print(scenario_toml(resolved))
    for line in captured.get().splitlines():
        print(f"{_COMMENT}{line}".rstrip())
    return ExitStatus.OK


def _print_plant(console: Console, resolved: Scenario) -> None:
    """Print what a plant is near its operating point, and what holds of keys without a value."""
    from cosim.analysis.model_comparison import linearisation, said
    from plant_server.systems.system_from_settings import system_of

    if not resolved.coverage.is_linear:
        about = getattr(system_of(resolved), "about", resolved.plant.system.kind)
        console.print(f"the plant: {about}", highlight=False, markup=False)
    if (near := linearisation(resolved)) is not None:
        for what, value in said(near):
            console.print(f"{what}: {value}", highlight=False, markup=False)
    for line in _in_force(resolved):
        console.print(line, highlight=False, markup=False)


def _in_force(resolved: Scenario) -> Iterator[str]:
    """Say what holds of keys that have no value, and whose default depends on others."""
    from cosim.live.restart_policy import RESTART_BY_HAND_S
    from cosim.live.start_limit import DEFAULT_S

    watchdog, timeout_s = resolved.plant.watchdog, resolved.timing.actuation_timeout_ns / NS_PER_S
    if watchdog.timeout_s is None:
        yield f"plant.watchdog: {watchdog.policy} when no actuation has come for {timeout_s:g} s"
    if resolved.controller.safe_input is None:
        yield "controller.safe_input: 0, while the controller knows no state"
    if resolved.recovery.rejoin_within_s is None:
        yield (
            "recovery.rejoin_within_s: 0, who dies ends the run; "
            f"{RESTART_BY_HAND_S:g} for processes that people start"
        )
    if resolved.start_within_s is None:
        yield f"start_within_s: {DEFAULT_S:g}, longer under load; unlimited if people start some"


@command(FILES, [
    ("noack schema > scenario.schema.json", "for an editor that completes keys"),
    ("noack schema --campaign", ""),
    ("noack schema --netem", ""),
])  # fmt: skip
def schema(
    netem: Annotated[
        bool, typer.Option("--netem", help="Of the emulator's links files instead.")
    ] = False,
    campaign: Annotated[
        bool, typer.Option("--campaign", help="Of campaign files instead.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Print the JSON Schema of scenario files, for editors."""
    if campaign:
        from cosim.studies.campaign.campaign_file import json_schema as campaign_schema

        print_json(campaign_schema())
    elif netem:
        from netem.words.links_file import json_schema as links_schema

        print_json(links_schema())
    else:
        print_json(json_schema())
    return ExitStatus.OK

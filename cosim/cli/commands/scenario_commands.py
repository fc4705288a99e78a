"""``noack scenarios``, ``check``, ``schema``: scenario files."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.shipped_files import KINDS, ShippedFile, all_shipped, text_of
from noack.core.clock import NS_PER_S
from noack.core.errors import ExitStatus

if TYPE_CHECKING:
    from rich.console import Console

    from noack.config.scenario import Scenario

_COMMENT = "# "


@cli.command(cli.FILES, 20, [
    ("noack scenarios", "list them all"),
    ("noack scenarios unstable_pendulum > mine.toml", "copy one, to make it your own"),
    ("noack scenarios --json", "list them as JSON"),
])  # fmt: skip
def scenarios(
    name: Annotated[str | None, Argument(autocompletion=completion.shipped)] = None,
    *,
    json: cli.JsonOption = False,
) -> int:
    """List the shipped scenarios and campaigns, or print one of them.

    Options:
        name: Print this scenario or campaign.
    """
    if name is not None:
        text = text_of(name)
        cli.print_json({"name": name, "toml": text}) if json else print(text, end="")
        return ExitStatus.OK
    shipped = {kind: all_shipped(kind) for kind in KINDS}
    if json:
        cli.print_json({
            kind: [file._asdict() | {"path": str(file.path)} for file in some]
            for kind, some in shipped.items()
        })  # fmt: skip
        return ExitStatus.OK
    console = cli.console()
    for kind, some in shipped.items():
        console.print(kind, style="bold", highlight=False)
        _print_shipped(console, some)
    return ExitStatus.OK


def _print_shipped(console: "Console", some: Sequence[ShippedFile]) -> None:
    """Print one line per file to a pipe, or a wrapped table to a terminal."""
    width = max(len(file.name) for file in some)
    if not console.is_terminal:
        for file in some:
            print(f"{file.name:{width}}  {file.description}")
        return
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=width, no_wrap=True, style="cyan")
    table.add_column()
    for file in some:
        table.add_row(file.name, file.description)
    console.print(table)


@cli.command(cli.FILES, 30, [
    ("noack check lane_following", "print the scenario and its assumptions"),
    ("noack check lane_following --set mode=zoh --json", "as JSON"),
])  # fmt: skip
def check(
    scenario: cli.ScenarioArgument, *, settings: cli.SetOption = None, json: cli.JsonOption = False
) -> int:
    """Check a scenario and print it with all defaults and random draws filled in.

    The output is a scenario file. Comments at its end say which of the paper's assumptions hold.

    A nonlinear plant is also started and linearised. For a plant in Python this runs its code.
    """
    from cosim.output.run_verdict import print_assumptions
    from noack.config.link_load import require_capacity
    from noack.config.resolution import resolve
    from noack.config.scenario import loop_names
    from noack.config.scenario_file import dumps as scenario_toml
    from noack.theory.certificates.assumptions import assumptions

    loaded = cli.load_scenario(scenario, settings)
    if len(loop_names(loaded)) > 1:
        return _check_loops(loaded, json=json)
    resolved = resolve(loaded)
    _make_trigger(resolved)
    require_capacity(loaded)
    console = cli.console()
    console.width -= len(_COMMENT)
    with console.capture() as captured:  # printed last: the plant may be rejected
        console.print("the paper's assumptions for this scenario:")
        print_assumptions(console, assumptions(resolved))
        _print_plant(console, resolved)
    if json:
        cli.print_json(resolved.model_dump(mode="json"))
        return ExitStatus.OK
    print(scenario_toml(resolved))
    for line in captured.get().splitlines():
        print(f"{_COMMENT}{line}".rstrip())
    return ExitStatus.OK


def _make_trigger(resolved: "Scenario") -> None:
    """Make the trigger: some policies need a stable loop, others a user's class."""
    from noack.config.resolution import policy_of
    from noack.trigger.trigger_rule import CodedPolicy

    policy = policy_of(resolved)
    if isinstance(policy, CodedPolicy):
        policy.new_trigger()


def _check_loops(scenario: "Scenario", *, json: bool) -> int:
    """Check each loop and the bottleneck; print the scenario, which is not resolved."""
    from noack.config.link_load import (
        link_loads,
        load_warnings,
        require_capacity,
        update_delay,
    )
    from noack.config.resolution import resolved_loops
    from noack.config.scenario import phases_ns
    from noack.config.scenario_file import dumps as scenario_toml

    loops, loads = resolved_loops(scenario), link_loads(scenario)
    for loop in loops:
        _make_trigger(loop)
    require_capacity(scenario)
    if json:
        cli.print_json(scenario.model_dump(mode="json"))
        return ExitStatus.OK
    print(scenario_toml(scenario))
    for loop, phase_ns in zip(loops, phases_ns(scenario), strict=True):
        x0 = ", ".join(f"{value:.4g}" for value in loop.plant.initial_state)
        print(f"{_COMMENT}{loop.name}: begins at {phase_ns / NS_PER_S:.6f} s, x(0) = ({x0})")
    for load in loads:
        delay = load.delay_bound_s
        print(
            f"{_COMMENT}{load.key}: {load.begin}{load.rate_bps:.0f} bit/s; "
            f"datagrams that must pass: {load.mandatory_at_least_bps:.0f} to "
            f"{load.mandatory_at_most_bps:.0f} bit/s; delay: "
            + ("no bound" if delay is None else f"at most {delay:.4g} s in virtual time")
        )
    updates = update_delay(scenario)
    print(
        f"{_COMMENT}delay of updates in the network: "
        + (f"at most {updates.largest_s:.4g} s" if math.isfinite(updates.largest_s) else "no bound")
        + f" in virtual time; the certificates cover {updates.certified_s:.4g} s"
    )
    for line in load_warnings(loads, scenario):
        print(f"{_COMMENT}warning: {line}")
    return ExitStatus.OK


def _print_plant(console: "Console", resolved: "Scenario") -> None:
    """Print a nonlinear plant's linearisation, and the defaults that depend on other keys."""
    from controller_node.controller import law_of
    from cosim.analysis.run_summary import linearisation, linearisation_rows
    from plant_server.plant import system_of

    if not resolved.coverage.is_linear:
        about = getattr(system_of(resolved), "about", resolved.plant.system.kind)
        console.print(f"the plant: {about}", highlight=False, markup=False)
    if (law := getattr(law_of(resolved), "about", None)) is not None:
        console.print(f"the controller: {law}", highlight=False, markup=False)
    if (near := linearisation(resolved)) is not None:
        for what, value in linearisation_rows(near):
            console.print(f"{what}: {value}", highlight=False, markup=False)
    for line in _dependent_defaults(resolved):
        console.print(line, highlight=False, markup=False)


def _dependent_defaults(resolved: "Scenario") -> Iterator[str]:
    """Yield the keys without a value whose default depends on other keys."""
    from cosim.live.child_processes import RESTART_BY_HAND_S
    from cosim.live.launcher import DEFAULT_S

    watchdog, timeout_s = resolved.plant.watchdog, resolved.timing.actuation_timeout_ns / NS_PER_S
    if watchdog.timeout_s is None:
        yield (
            f"plant.watchdog: policy {watchdog.policy}, after {timeout_s:g} s without an actuation"
        )
    if resolved.controller.safe_input is None:
        yield "controller.safe_input: 0, the input before the first update"
    if resolved.recovery.rejoin_within_s is None:
        yield (
            "recovery.rejoin_within_s: 0, a process that dies ends the run; with `noack record`: "
            f"{RESTART_BY_HAND_S:g} s to restart it"
        )
    if resolved.start_within_s is None:
        yield (
            f"start_within_s: {DEFAULT_S:g}, longer on a busy machine; with `noack record`: "
            "unlimited"
        )


@cli.command(cli.FILES, 40, [
    ("noack schema > scenario.schema.json", "for an editor that completes keys"),
    ("noack schema --campaign", "the schema of campaign files"),
    ("noack schema --netem", "the schema of the emulator's links files"),
])  # fmt: skip
def schema(
    *,
    netem: Annotated[bool, Option("--netem")] = False,
    campaign: Annotated[bool, Option("--campaign")] = False,
    json: cli.JsonOption = False,
) -> int:
    """Print the JSON Schema of scenario files, for editors.

    Options:
        netem: Print the schema of the emulator's links files.
        campaign: Print the schema of campaign files.
    """
    if campaign:
        from cosim.studies.campaign.campaign_file import json_schema as campaign_schema

        cli.print_json(campaign_schema())
    elif netem:
        from netem.tc_words import json_schema as links_schema

        cli.print_json(links_schema())
    else:
        from noack.config.scenario import Scenario
        from noack.config.toml_file import json_schema

        cli.print_json(json_schema(Scenario))
    return ExitStatus.OK

"""Commands on scenario files."""

from rich.console import Console

from cosim.cli.app import (
    FILES,
    JsonOption,
    ScenarioArgument,
    SetOption,
    command,
    find_scenario,
    print_json,
)
from noack.errors import ExitStatus
from noack.scenario_file import dumps as scenario_toml
from noack.scenario_file import json_schema, load


@command(FILES)
def check(scenario: ScenarioArgument, settings: SetOption = None, json: JsonOption = False) -> int:
    """Check a scenario and print it resolved: defaults, named models and draws made explicit."""
    from cosim.tables import print_assumptions
    from noack.resolve import resolve
    from noack.theory.assumptions import assumptions

    resolved = resolve(load(find_scenario(scenario), settings or ()))
    verdicts = [assumption._asdict() for assumption in assumptions(resolved)]
    print_assumptions(Console(stderr=True), verdicts)
    if json:
        print_json(resolved.model_dump(mode="json"))
    else:
        print(scenario_toml(resolved), end="")
    return ExitStatus.OK


@command(FILES)
def schema(json: JsonOption = False) -> int:
    """Print the JSON Schema of scenario files, for editors."""
    print_json(json_schema())
    return ExitStatus.OK

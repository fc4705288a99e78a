"""``noack certify``: bounds that hold for every pattern of losses."""

from typing import Annotated

import typer
from rich.console import Console

from cosim.cli.command import (
    THEORY,
    JsonOption,
    ScenarioArgument,
    SetOption,
    command,
    find_scenario,
    print_json,
)
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus


@command(THEORY, 10, [
    ("noack certify lane_following", "its plant, and all plants of its uncertainty box"),
    ("noack certify lane_following --weight chosen", "with a norm that certifies more"),
    ("noack certify lane_weighted --late 6 --json", "allow 6 steps of lateness"),
])  # fmt: skip
def certify(
    scenario: ScenarioArgument,
    *,
    settings: SetOption = None,
    weight: Annotated[
        str,
        typer.Option(
            help="Norm of the trigger: `given` in the scenario, `identity`, or `chosen` by noack."
        ),
    ] = "given",
    late: Annotated[
        int | None,
        typer.Option(
            help="Allowed lateness in steps of the plant; certificate.late_periods by default.",
            min=0,
            max=1000,
        ),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Compute the bounds that are guaranteed for a scenario, and their conditions.

    Exit status 1: nothing can be certified.
    """
    from cosim.live.progress import work_bar
    from cosim.output.certificate_report import print_study, study_scenario

    loaded = load(find_scenario(scenario), settings or ())
    with work_bar("choosing the weight") as progress:
        found = study_scenario(loaded, weight, late, progress)
    if json:
        print_json(found.to_json())
    else:
        print_study(Console(), found)
    certified = any(certificate.constants for _, certificate in found.certificates)
    return ExitStatus.OK if certified else ExitStatus.FAILED

"""``noack certify``: bounds that hold for every pattern of losses."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import ExitStatus


@cli.command(cli.THEORY, 10, [
    ("noack certify lane_following", "its plant, and all plants of its uncertainty box"),
    ("noack certify lane_following --weight chosen", "with a norm that certifies more"),
    ("noack certify lane_weighted --late 6 --json", "allow 6 steps of lateness"),
])  # fmt: skip
def certify(
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
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
    tables: cli.TablesOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Write the certificates for MATLAB and Octave (.mat)."),
    ] = None,
    json: cli.JsonOption = False,
) -> int:
    """Compute the bounds that are guaranteed for a scenario, and their conditions.

    Exit status 1: nothing can be certified.
    """
    from cosim.output.certificate_report import certificate_tables, print_certificates
    from cosim.output.certificates import certificates_of

    loaded = cli.load_scenario(scenario, settings)
    if weight == "chosen":
        from cosim.live.progress import work_bar

        with work_bar("choosing the weight") as progress:
            found = certificates_of(loaded, weight, late, progress)
    else:
        found = certificates_of(loaded, weight, late)
    if json:
        cli.print_json(found.to_json())
    else:
        print_certificates(cli.console(), found)
    cli.write_tables(certificate_tables(found), tables, json=json)
    if out is not None:
        from cosim.output.export.mat_export import save_mat

        save_mat(found.to_json(), out)
    certified = any(certificate.constants for _, certificate in found)
    return ExitStatus.OK if certified else ExitStatus.FAILED

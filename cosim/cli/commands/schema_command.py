"""``noack schema``: JSON Schemas of the files that noack reads."""

from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import ExitStatus


@cli.command(cli.FILES, 40, [
    ("noack schema > scenario.schema.json", "for an editor that completes keys"),
    ("noack schema --campaign", "the schema of campaign files"),
    ("noack schema --netem", "the schema of the emulator's links files"),
])  # fmt: skip
def schema(
    *,
    netem: Annotated[
        bool, typer.Option("--netem", help="Print the schema of the emulator's links files.")
    ] = False,
    campaign: Annotated[
        bool, typer.Option("--campaign", help="Print the schema of campaign files.")
    ] = False,
    json: cli.JsonOption = False,
) -> int:
    """Print the JSON Schema of scenario files, for editors."""
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

"""``noack scenarios``: the scenarios and campaigns that come with noack."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.shipped_files import KINDS, ShippedFile, all_shipped, text_of
from noack.core.errors import ExitStatus

if TYPE_CHECKING:
    from rich.console import Console


@cli.command(cli.FILES, 20, [
    ("noack scenarios", "list them all"),
    ("noack scenarios unstable_pendulum > mine.toml", "copy one, to make it your own"),
    ("noack scenarios --json", "list them as JSON"),
])  # fmt: skip
def scenarios(
    name: Annotated[
        str | None,
        typer.Argument(help="Print this scenario or campaign.", autocompletion=completion.shipped),
    ] = None,
    *,
    json: cli.JsonOption = False,
) -> int:
    """List the shipped scenarios and campaigns, or print one of them."""
    if name is not None:
        text = text_of(name)
        cli.print_json({"name": name, "toml": text}) if json else print(text, end="")
        return ExitStatus.OK
    shipped = {kind: all_shipped(kind) for kind in KINDS}
    if json:
        cli.print_json({
            kind: [one._asdict() | {"path": str(one.path)} for one in some]
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
    width = max(len(one.name) for one in some)
    if not console.is_terminal:
        for one in some:
            print(f"{one.name:{width}}  {one.description}")
        return
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=width, no_wrap=True, style="cyan")
    table.add_column()
    for one in some:
        table.add_row(one.name, one.description)
    console.print(table)

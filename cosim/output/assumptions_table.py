"""What a person sees of assumptions: the paper's for a scenario, a certificate's."""

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from noack.theory.assumptions import AssumptionStatus

_COLOURS: dict[str, str] = {
    AssumptionStatus.HOLDS: "green",
    AssumptionStatus.VIOLATED: "bold yellow",
    AssumptionStatus.IDEALISED: "dim",
    AssumptionStatus.NOT_NEEDED: "dim",
    AssumptionStatus.PRESUPPOSED: "cyan",
}


def print_assumptions(console: Console, assumptions: Sequence[Mapping[str, str]]) -> None:
    """Print assumptions with their verdicts; one that is idealised or not needed is a note."""
    table = Table.grid(padding=(0, 2))
    for one in assumptions:
        text = escape(f"{one['what']} ({one['source']}): {one['why']}")
        table.add_row(Text(one["verdict"], _COLOURS.get(one["verdict"], "")), text)
    console.print(table)

"""Table of assumptions: those of the paper for a scenario, or those of a certificate."""

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cosim.analysis.summary_model import AssumptionPart
from noack.theory.certificates.assumptions import Assumption, AssumptionStatus

_COLOURS: dict[str, str] = {
    AssumptionStatus.HOLDS: "green",
    AssumptionStatus.VIOLATED: "bold yellow",
    AssumptionStatus.IDEALISED: "dim",
    AssumptionStatus.NOT_NEEDED: "dim",
    AssumptionStatus.ASSUMED: "cyan",
}


def print_assumptions(console: Console, assumptions: Sequence[Assumption | AssumptionPart]) -> None:
    """Print assumptions with their verdicts."""
    table = Table.grid(padding=(0, 2))
    for one in assumptions:
        source = one.source if one.source.startswith("(") else f"({one.source})"
        text = escape(f"{one.what} {source}: {one.why}")
        table.add_row(Text(one.verdict, _COLOURS.get(one.verdict, "")), text)
    console.print(table)

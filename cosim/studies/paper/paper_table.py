"""The output of ``noack paper``: the claims, and the path of the page."""

from typing import Any

from rich.console import Console
from rich.table import Table

from cosim.studies.paper.paper_claims import PaperVerdict

_STYLES = {
    PaperVerdict.CONFIRMED: "green",
    PaperVerdict.PARTLY: "yellow",
    PaperVerdict.NOT_CONFIRMED: "bold red",
}


def print_claims(console: Console, found: dict[str, Any]) -> None:
    """Print the result of :func:`cosim.studies.paper.paper_run.document`."""
    table = Table(title=f"Section V over {found['draws']:,} draws", show_lines=True)
    for heading in ("the paper says", "verdict", "numbers"):
        table.add_column(heading)
    for claim in found["claims"]:
        style = _STYLES[claim["verdict"]]
        table.add_row(claim["gist"], f"[{style}]{claim['verdict']}[/]", claim["why"])
    console.print(table)
    for file in found["files"]:
        console.print(file, highlight=False, soft_wrap=True, markup=False)

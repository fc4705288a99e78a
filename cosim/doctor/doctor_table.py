"""The findings, as a person or a program wants to see them."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cosim.doctor.findings import FindingStatus, MachineFinding, worst
from cosim.doctor.machine_facts import MachineFacts, RunRequirements

_COLOURS = {
    FindingStatus.GOOD: "green",
    FindingStatus.LIMITED: "yellow",
    FindingStatus.BAD: "bold red",
}
_IN_SHORT = {
    FindingStatus.GOOD: "grants all that there is to ask for",
    FindingStatus.LIMITED: "is fit for runs, within limits",
    FindingStatus.BAD: "cannot run it",
}


def document(
    machine: MachineFacts, wanted: RunRequirements, findings: Sequence[MachineFinding]
) -> dict[str, Any]:
    """As one document: ``verdict``, ``findings``, and the numbers behind them."""
    return {
        "scenario": wanted._asdict() | {"ports": dict(wanted.ports)},
        "verdict": worst(findings),
        "findings": [one._asdict() for one in findings],
        "measured": {
            name: value._asdict() if hasattr(value, "_asdict") else value
            for name, value in asdict(machine).items()
        },
    }


def print_findings(
    console: Console, wanted: RunRequirements, findings: Sequence[MachineFinding]
) -> None:
    """Print a line for each finding, and below it what it means and what would be better."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(max_width=26)
    table.add_column(ratio=1)
    for one in findings:
        said = Text(one.found)
        if one.means:
            said.append(f"\n{one.means}", "" if one.verdict is not FindingStatus.GOOD else "dim")
        if one.remedy:
            said.append(f"\n→ {one.remedy}", "cyan")
        table.add_row(Text(one.verdict, _COLOURS[one.verdict]), Text(one.what), said)
    console.print(table)
    verdict = worst(findings)
    console.print(
        Text.assemble(
            "for ", wanted.name, ": this machine ", (_IN_SHORT[verdict], _COLOURS[verdict])
        )
    )

"""The findings of ``noack doctor``, as a table and as JSON."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cosim.doctor.findings import FindingStatus, MachineFinding, worst
from cosim.doctor.machine_facts import MachineFacts, RunRequirements

_VERDICTS = {
    FindingStatus.GOOD: ("green", "ready"),
    FindingStatus.LIMITED: ("yellow", "ready, with the limits above"),
    FindingStatus.BAD: ("bold red", "not ready: no run is possible"),
}
"""Colour of a finding; verdict on the machine if this is the worst finding."""


def document(
    machine: MachineFacts, wanted: RunRequirements, findings: Sequence[MachineFinding]
) -> dict[str, Any]:
    """Return ``verdict``, ``findings``, and the numbers behind them, for JSON."""
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
    """Print each finding, its meaning for a run, and a remedy."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(max_width=26)
    table.add_column(ratio=1)
    for one in findings:
        text = Text(one.found)
        if one.means:
            text.append(f"\n{one.means}", "" if one.verdict is not FindingStatus.GOOD else "dim")
        if one.remedy:
            text.append(f"\n→ {one.remedy}", "cyan")
        table.add_row(Text(one.verdict, _VERDICTS[one.verdict][0]), Text(one.what), text)
    console.print(table)
    colour, verdict = _VERDICTS[worst(findings)]
    console.print(Text.assemble("this machine, for ", wanted.name, ": ", (verdict, colour)))

"""Prints the repetition of an archived run."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cosim.studies.reproduction.run_repetition import Repetition
from noack.core.errors import printable


def print_repetition(console: Console, found: Repetition) -> None:
    """Print what was compared, and what differs: bits, numbers, versions and machine.

    Texts of the archive are printed without control characters.
    """
    what = "inputs replayed" if found.kind == "live" else "rows repeated"
    verdict = ("bit-exact", "green") if found.bit_exact else ("not reproduced", "bold red")
    if not found.compared:
        verdict = "nothing to compare", "bold red"
    lines = [
        Text(
            printable(f"{found.scenario}, {found.kind}: {verdict[0]}, {found.compared:,} {what}"),
            verdict[1],
        )
    ]
    lines += [Text(printable(f"first difference: {text}")) for text in found.differences]
    lines += [Text(printable(f"record incomplete: {text}"), "yellow") for text in found.gaps]
    for line in lines:
        console.print(line, soft_wrap=True)
    if found.numbers:
        title = "numbers that differ"
        if found.kind == "live":
            title += ": the simulation has no lateness"
        table = Table("quantity", "archived", "repeated", title=title)
        for place in (1, 2):
            table.columns[place].justify = "right"
        for row in found.numbers:
            table.add_row(*(Text(printable(cell)) for cell in row))
        console.print(table)
    for change in found.changes:
        text = printable(f"differs from the archived run's machine: {change}")
        console.print(Text(text), soft_wrap=True)

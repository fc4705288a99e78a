"""Prints the result of a replay as a table."""

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.analysis.replay.replay_result import Replay
from cosim.analysis.summary_model import ReplayDifference


def print_replay(console: Console, found: Replay, changed: Sequence[str]) -> None:
    """Print the result of a replay, and what ``changed`` since the run on its computer."""
    table = Table(title="replay, compared bit for bit")
    for heading in ("process or link", "recorded", "compared", "verdict"):
        table.add_column(heading, justify="left" if heading == "process or link" else "right")
    rows = [(one.process, one.inputs, one.compared, one.difference) for one in found.processes]
    rows += [(one.leg, one.received, one.compared, one.difference) for one in found.messages]
    for name, recorded, compared, difference in rows:
        table.add_row(name, f"{recorded:,}", f"{compared:,}", _verdict(compared, difference))
    console.print(table)
    lines = [f"[bold yellow]record incomplete:[/] {escape(gap)}" for gap in found.gaps]
    if (first := found.first_difference) is None:
        word = f"bit-exact: {found.inputs:,} inputs" if found.inputs else "nothing to compare"
        lines.append(word + (" so far as the record goes" if found.gaps else ""))
    else:
        lines.append(f"[bold red]first difference:[/] {escape(str(first))}")
        lines += [
            f"[bold yellow]not the machine of the run:[/] {escape(change)}; "
            "the last bits of a product may depend on it"
            for change in changed
        ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)


def _verdict(compared: int, difference: ReplayDifference | None) -> str:
    if difference is not None:
        place = f"{difference.table}[{difference.row}].{difference.column}".rstrip(".")
        return f"[red]≠[/] {escape(place)}"
    return "bit-exact" if compared else "-"

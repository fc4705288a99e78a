"""Prints the result of a replay as a table."""

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.analysis.replay.replay_result import Replay, ReplayDifference


def print_replay(console: Console, found: Replay, changed: Sequence[str]) -> None:
    """Print the result of a replay.

    Args:
        console: the console.
        found: the result.
        changed: differences between the computer of the run and this one, in words.
    """
    table = Table(title="replay, bit for bit")
    table.add_column("process, leg")
    for heading in ("recorded", "compared", "verdict"):
        table.add_column(heading, justify="right")
    for process in found.processes:
        verdict = _verdict(process.compared, process.difference)
        table.add_row(process.process, *_counts(process.inputs, process.compared), verdict)
    for leg in found.messages:
        verdict = _verdict(leg.compared, leg.difference)
        table.add_row(leg.leg, *_counts(leg.received, leg.compared), verdict)
    console.print(table)
    for gap in found.gaps:
        console.print(
            f"[bold yellow]record incomplete:[/] {escape(gap)}", highlight=False, soft_wrap=True
        )
    first = found.first_difference
    if first is None:
        word = f"bit-exact: {found.inputs:,} inputs" if found.inputs else "nothing to compare"
        console.print(
            word + (" so far as the record goes" if found.gaps else ""),
            highlight=False,
            soft_wrap=True,
        )
        return
    console.print(
        f"[bold red]first difference:[/] {escape(str(first))}", highlight=False, soft_wrap=True
    )
    for change in changed:
        console.print(
            f"[bold yellow]not the machine of the run:[/] {escape(change)}; "
            "the last bits of a product may depend on it",
            highlight=False,
            soft_wrap=True,
        )


def _counts(recorded: int, compared: int) -> tuple[str, str]:
    return f"{recorded:,}", f"{compared:,}"


def _verdict(compared: int, difference: ReplayDifference | None) -> str:
    if difference is not None:
        place = f"{difference.table}[{difference.row}].{difference.column}".rstrip(".")
        return f"[red]≠[/] {escape(place)}"
    return "bit-exact" if compared else "-"

"""The totals of a relay, as a table for people."""

from collections.abc import Callable, Iterator, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from netem.control.emulator_statistics import (
    DelayQuantiles,
    DirectionStatistics,
    LinkStatistics,
    Statistics,
    unintended,
)
from netem.control.number_texts import NONE, percent_text, time_text
from netem.control.statistics_view import burst_text
from netem.engine.relay_interface import DIRECTIONS
from noack.core.errors import ExitStatus

_COUNTS: dict[str, Callable[[DirectionStatistics], int]] = {
    "dropped by a loss model": lambda side: side["fates"]["dropped"],
    "corrupted": lambda side: side["fates"]["corrupted"],
    "dropped by a full queue": lambda side: side["fates"]["overflowed"],
    "dropped in a blackout": lambda side: side["fates"]["blacked_out"],
    "forced by the guarantee": lambda side: side["fates"]["forced"],
    "delivered out of order (stale)": lambda side: side["delivered_out_of_order"],
    "held back for the guarantee": lambda side: side["held_back"],
    "duplicated": lambda side: side["duplicated"],
    "in flight at the end": lambda side: side["in_flight"],
}
"""Rows that are shown if their value is not 0."""


_Row = tuple[str, Sequence[str], str]
"""Label, a text per direction, style."""


def print_totals(totals: Statistics, console: Console, *, predicted: bool) -> None:
    """Print a table for each link; settings do not predict the loss of replayed fates."""
    for link in totals["links"]:
        clients = link["clients_ever"]
        title = f"{link['name']}: {link['listen']} → {link['to']}, {clients:,} client"
        # As text: the brackets of an IPv6 address are not markup.
        console.print(Text(title + "s" * (clients != 1), "bold"), soft_wrap=True)
        console.print(_table(link, predicted))
    if lost := unintended(totals):
        status = ExitStatus.UNINTENDED_LOSSES
        console.print(
            f"unintended losses: {lost:,} datagrams; the guarantee does not hold (exit status "
            f"{status})", style="bold red", soft_wrap=True,
        )  # fmt: skip


def _table(link: LinkStatistics, predicted: bool) -> Table:
    reverse = link["reverse"]
    both = bool(reverse["received"] or reverse["words"] or link["discarded"])
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("")
    for name in DIRECTIONS[: 1 + both]:
        table.add_column(name, justify="right")
    for label, texts, style in _rows(link, predicted):
        table.add_row(label, *texts[: 1 + both], style=style)
    return table


def _rows(link: LinkStatistics, predicted: bool) -> Iterator[_Row]:
    sides = link["forward"], link["reverse"]

    def row(label: str, text: Callable[[DirectionStatistics], str]) -> _Row:
        return label, tuple(map(text, sides)), ""

    yield row("received", lambda side: f"{side['received']:,}")
    yield row("forwarded", lambda side: f"{side['forwarded']:,}")
    for label, count in _COUNTS.items():
        if any(map(count, sides)):
            yield row(label, _number(count))
    if any(side["received_before"] for side in sides):
        yield "since the last change:", (), "dim"
    yield row("longest loss burst", burst_text)
    yield row("loss rate", lambda side: percent_text(side["loss"]["lost"]))
    if predicted and any(side["loss"]["predicted"] is not None for side in sides):
        full = any(side["fates"]["overflowed"] for side in sides)
        label = "  predicted, without full queues" if full else "  predicted"
        yield row(label, lambda side: percent_text(side["loss"]["predicted"]))
    if any(side["delivered_out_of_order"] for side in sides):
        yield row("loss rate with stale", lambda side: percent_text(side["loss"]["realised"]))
    yield row("delay p50, p99", lambda side: _times(side["delay_ns"]))
    if any(side["lateness_ns"]["p50"] is not None for side in sides):
        yield row("lateness p50, p99", lambda side: _times(side["lateness_ns"]))
    for cause in sorted({cause for side in sides for cause, n in side["unintended"].items() if n}):
        numbers = tuple(f"{side['unintended'].get(cause, 0):,}" for side in sides)
        yield (f"unintended: {cause.replace('_', ' ')}", numbers, "bold red")
    if link["refused"]:
        yield ("refused: too many clients", (f"{link['refused']:,}",), "bold red")
    if link["port_unreachable"]:
        yield ("port unreachable (ICMP)", (f"≥ {link['port_unreachable']:,}",), "yellow")
    if link["discarded"]:
        yield "answers discarded (--one-way)", ("", f"{link['discarded']:,}"), ""


def _number(count: Callable[[DirectionStatistics], int]) -> Callable[[DirectionStatistics], str]:
    return lambda side: f"{count(side):,}"


def _times(times: DelayQuantiles) -> str:
    if times["p50"] is None:
        return NONE
    return f"{time_text(times['p50'])}, {time_text(times['p99'])}"

"""What a relay has done, as a table for people."""

from collections.abc import Iterator
from typing import Literal, NamedTuple

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
from noack.core.errors import ExitStatus

_CAUSES = {
    "dropped": "dropped by loss",
    "corrupted": "corrupted",
    "overflowed": "dropped from a full queue",
    "blacked_out": "dropped in a blackout",
}
_COUNTS = {
    "delivered_out_of_order": "overtaken (stale)",
    "held_back": "held back, not to overtake too many",
    "duplicated": "sent twice",
    "in_flight": "still under way",
}


class _Row(NamedTuple):
    label: str
    forward: str
    reverse: str
    style: str = ""


def print_totals(totals: Statistics, console: Console, *, predicted: bool) -> None:
    """Print a table for each link.

    Args:
        totals: what has happened.
        console: where to.
        predicted: whether the settings predict the loss, as no recorded fates were taken again.
    """
    for link in totals["links"]:
        console.print(_table(link, predicted))
    if lost := unintended(totals):
        status = ExitStatus.UNINTENDED_LOSSES
        console.print(
            f"unintended losses: {lost:,} datagrams; the guarantee does not hold (exit status "
            f"{status})", style="bold red", soft_wrap=True,
        )  # fmt: skip


def _table(link: LinkStatistics, predicted: bool) -> Table:
    clients = link["clients_ever"]
    table = Table(
        # As text: the brackets of an IPv6 address are no markup.
        title=Text(
            f"{link['name']}: {link['listen']} → {link['to']}, "
            f"{clients:,} client{'' if clients == 1 else 's'}", "bold",
        ),
        title_justify="left", box=None, padding=(0, 2, 0, 0),
    )  # fmt: skip
    table.add_column("")
    table.add_column("forward", justify="right")
    both = bool(link["reverse"]["arrived"] or link["reverse"]["words"] or link["discarded"])
    if both:
        table.add_column("reverse", justify="right")
    for row in _rows(link, predicted):
        cells = (row.forward, row.reverse) if both else (row.forward,)
        table.add_row(row.label, *cells, style=row.style)
    return table


def _rows(link: LinkStatistics, predicted: bool) -> Iterator[_Row]:
    sides = forward, reverse = link["forward"], link["reverse"]
    yield _Row("came", _number(forward["arrived"]), _number(reverse["arrived"]))
    yield _Row("left", _number(forward["forwarded"]), _number(reverse["forwarded"]))
    for fate, label in _CAUSES.items():
        yield from _some(label, forward["fates"][fate], reverse["fates"][fate])
    yield from _some("forced through", forward["fates"]["forced"], reverse["fates"]["forced"])
    for key, label in _COUNTS.items():
        yield from _some(label, forward[key], reverse[key])  # type: ignore[literal-required]
    if forward["arrived_before"] or reverse["arrived_before"]:
        yield _Row("since the last change:", "", "", "dim")
    yield _Row("most in a row not delivered", _run(forward), _run(reverse))
    yield _Row("lost", _share(forward, "lost"), _share(reverse, "lost"))
    if predicted and any(side["loss"]["predicted"] is not None for side in sides):
        full = forward["fates"]["overflowed"] or reverse["fates"]["overflowed"]
        what = "but for full queues" if full else "in the long run"
        yield _Row(
            f"  predicted {what}", _share(forward, "predicted"), _share(reverse, "predicted")
        )
    if forward["delivered_out_of_order"] or reverse["delivered_out_of_order"]:
        yield _Row("lost or stale", _share(forward, "realised"), _share(reverse, "realised"))
    yield _Row(
        "delay: median, 99 % within", _times(forward["delay_ns"]), _times(reverse["delay_ns"])
    )
    late = (forward["lateness_ns"], reverse["lateness_ns"])
    if any(times["p50"] is not None for times in late):
        yield _Row("lateness: median, 99 % within", *map(_times, late))
    for cause in {**forward["unintended"], **reverse["unintended"]}:
        there, here = (side["unintended"].get(cause, 0) for side in sides)
        yield from _some(f"unintended: {cause.replace('_', ' ')}", there, here, "bold red")
    if link["refused"]:
        yield _Row("refused: too many clients", _number(link["refused"]), "", "bold red")
    if link["port_unreachable"]:
        yield _Row("nobody listened (ICMP)", f"≥ {link['port_unreachable']:,}", "", "yellow")
    if link["discarded"]:
        yield _Row("answers discarded, one way", "", _number(link["discarded"]))


def _some(label: str, forward: int, reverse: int, style: str = "") -> Iterator[_Row]:
    if forward or reverse:
        yield _Row(label, _number(forward), _number(reverse), style)


def _number(number: int) -> str:
    return f"{number:,}"


def _run(side: DirectionStatistics) -> str:
    cap = "" if side["mansd"] is None else f" of {side['mansd']:,} allowed"
    return f"{side['longest_loss_burst']:,}{cap}"


def _share(side: DirectionStatistics, which: Literal["lost", "predicted", "realised"]) -> str:
    return percent_text(side["loss"][which])


def _times(times: DelayQuantiles) -> str:
    if times["p50"] is None:
        return NONE
    return f"{time_text(times['p50'])}, {time_text(times['p99'])}"

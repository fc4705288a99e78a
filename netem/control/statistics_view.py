"""An emulator's statistics as a picture in the terminal.

Drawn in full if there is room: a panel for each link with its two directions side by side. With
more links than fit, a table with a line for each direction.
"""

from collections.abc import Callable, Sequence
from typing import Literal

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from netem.control.emulator_statistics import (
    DelayQuantiles,
    DirectionStatistics,
    LinkStatistics,
    RecentRates,
    Statistics,
)
from netem.control.number_texts import (
    NONE,
    bar,
    bits_text,
    elapsed_text,
    percent_text,
    rate_text,
    sparkline,
    time_text,
)
from netem.control.statistics_history import History
from netem.engine.relay_interface import DIRECTIONS, Direction

_ARROWS = {"forward": "forward →", "reverse": "← reverse"}
_LABEL_WIDTH = 9
_FRAME_WIDTH = 4
_WORDS_LINES = 3
_CHART_WIDTH = 20
_LEAST_CHART_WIDTH = 8
_LOST = ("dropped", "corrupted", "overflowed", "blacked_out")


def render(history: History, title: str, width: int, height: int | None) -> RenderableType:
    """Return the picture of the latest statistics.

    Args:
        history: the statistics.
        title: of the emulator.
        width: columns of the terminal, for the charts.
        height: its lines; None for as many as are needed.
    """
    statistics = history.latest
    if statistics is None:
        return Text(f"{title}: waiting for statistics", style="dim")
    column = (width - _FRAME_WIDTH - _LABEL_WIDTH - 2) // 2
    panels = [_panel(history, link, column) for link in statistics["links"]]
    needed = 1 + sum(lines for _, lines in panels)
    if height is None or needed <= height:
        return Group(_heading(statistics, title), *(panel for panel, _ in panels))
    return Group(_heading(statistics, title), _table(history, statistics, width, height - 3))


def _heading(statistics: Statistics, title: str) -> Text:
    heading = Text(" ")
    heading.append(title, style="bold")
    heading.append(f"  {elapsed_text(statistics['elapsed_s'])}, {statistics['engine']}", "dim")
    return heading


def _panel(history: History, link: LinkStatistics, column: int) -> tuple[RenderableType, int]:
    """Return a link's panel, and of how many lines it is."""
    grid = Table.grid(padding=(0, 1, 0, 0), pad_edge=False)
    grid.add_column(width=_LABEL_WIDTH, style="dim")
    for _ in DIRECTIONS:
        grid.add_column(width=column)
    columns = [_cells(history, link["name"], name, link[name], column) for name in DIRECTIONS]
    lines = 2
    for (label, forward), (_, reverse) in zip(*columns, strict=True):
        grid.add_row(label, forward, reverse)
        lines += max(_lines(forward), _lines(reverse))
    unintended = _unintended(link)
    content: RenderableType = grid
    if unintended is not None:
        content = Group(grid, unintended)
        lines += 1
    title = Text.assemble(
        (link["name"], "bold"), f"  {link['listen']} → {link['to']}  ",
        (_clients_text(link), "dim"),
    )  # fmt: skip
    style = "blue" if unintended is None else "red"
    return Panel(content, title=title, title_align="left", border_style=style), lines


def _lines(cell: Text) -> int:
    return cell.plain.count("\n") + 1


def _clients_text(link: LinkStatistics) -> str:
    text = f"{link['clients']} client{'' if link['clients'] == 1 else 's'}"
    if link["refused"]:
        text += f", {link['refused']:,} datagrams refused"
    unheard = link["port_unreachable"]
    return f"{text}, {unheard:,} times nobody listened" if unheard else text


def _unintended(link: LinkStatistics) -> Text | None:
    """Return the line on unintended losses, if there are any."""
    causes = [
        f"{number:,} {cause.replace('_', ' ')} ({name})"
        for name in DIRECTIONS
        for cause, number in link[name]["unintended"].items()
        if number
    ]
    if not causes:
        return None
    return Text(
        f"unintended losses: {', '.join(causes)}", "bold white on red", no_wrap=True,
        overflow="ellipsis",
    )  # fmt: skip


def _cells(
    history: History, link: str, direction: Direction, of: DirectionStatistics, width: int
) -> list[tuple[str, Text]]:
    """Return the rows of a direction, each with its label."""
    recent = of["recent"]
    arrivals = history.series(link, direction, lambda recent: recent["arrived_per_s"], width)
    departures = history.series(link, direction, lambda recent: recent["forwarded_per_s"], width)
    losses = history.series(link, direction, lambda recent: recent["loss"], width)
    top = _top([*arrivals, *departures])
    loss, delay, late = of["loss"], of["delay_ns"], of["lateness_ns"]
    if recent is not None and recent["delay_ns"]["p50"] is not None:
        delay, late = recent["delay_ns"], recent["lateness_ns"]
    return [
        ("", Text(_ARROWS[direction], "bold cyan")),
        ("", _wrapped(of["words"] or "nothing is done", width)),
        ("in", _flow(recent, "arrived_per_s", "arrived_bits_per_s", width)),
        ("", Text(sparkline(arrivals, top), "green")),
        ("out", _flow(recent, "forwarded_per_s", "forwarded_bits_per_s", width)),
        ("", Text(sparkline(departures, top), "green")),
        ("loss", _loss(of)),
        ("", Text(sparkline(losses, _top([*losses, loss["predicted"]])), "yellow")),
        ("drawn", _drawn(of)),
        ("lost", _wrapped(_lost_text(of), width)),
        ("run", _run(of, width)),
        ("delay", _times(delay, width)),
        ("lateness", _times(late, width)),
        ("under way", Text(f"{of['in_flight']:,}  (most {of['most_in_flight']:,})")),
    ]


def _flow(
    recent: RecentRates | None,
    datagrams: Literal["arrived_per_s", "forwarded_per_s"],
    bits: Literal["arrived_bits_per_s", "forwarded_bits_per_s"],
    width: int,
) -> Text:
    if recent is None:
        return Text(NONE)
    rate, volume = rate_text(recent[datagrams]), bits_text(recent[bits])
    gap = min(13 - len(rate), width - len(rate) - len(volume))
    return Text.assemble((rate, "bold"), " " * max(gap, 1), volume)


def _times(times: DelayQuantiles, width: int) -> Text:
    if times["p50"] is None:
        return Text(NONE)
    text = f"p50 {time_text(times['p50']):<9} p99 {time_text(times['p99'])}"
    return Text(text if len(text) <= width else text.removeprefix("p50 ").replace("  ", " "))


def _top(values: Sequence[float | None]) -> float:
    return max((value for value in values if value is not None), default=0.0)


def _loss(of: DirectionStatistics) -> Text:
    loss = of["loss"]
    text = Text(percent_text(loss["lost"]), "bold")
    if loss["realised"] != loss["lost"]:
        text.append(f"  {percent_text(loss['realised'])} with what is stale", "dim")
    return text


def _drawn(of: DirectionStatistics) -> Text:
    loss = of["loss"]
    text = Text(percent_text(loss["drawn"]))
    if loss["predicted"] is not None:
        text.append(f"  {percent_text(loss['predicted'])} predicted", "dim")
    return text


def _lost_text(of: DirectionStatistics) -> str:
    lost = [(fate.replace("_", " "), of["fates"][fate]) for fate in _LOST]
    lost.append(("delivered_out_of_order", of["delivered_out_of_order"]))
    return ", ".join(f"{number:,} {cause}" for cause, number in lost if number) or "0"


def _run(of: DirectionStatistics, width: int) -> Text:
    longest, cap, forced = of["longest_loss_burst"], of["mansd"], of["fates"]["forced"]
    end = Text(f"  {forced:,} forced", "magenta") if forced else Text()
    if cap is None:
        return Text(f"{longest:,} in a row, no cap").append_text(end)
    text = Text(f"{longest:,} of {cap:,}")
    room = width - len(text) - len(end) - 2
    if room > 0:
        style = "green" if longest < cap else "yellow" if longest == cap else "bold red"
        filled, rest = bar(longest / cap if cap else float(longest > 0), room)
        text.append("  ").append(filled, style).append(rest, "dim")
    return text.append_text(end)


def _wrapped(text: str, width: int) -> Text:
    """Break a text into lines at its spaces; what is too long for the room is cut."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    if len(lines) > _WORDS_LINES:
        lines = [*lines[: _WORDS_LINES - 1], f"{lines[_WORDS_LINES - 1]} …"]
    return Text(
        "\n".join(line if len(line) <= width else line[: width - 1] + "…" for line in lines)
    )


def _table(history: History, statistics: Statistics, width: int, lines: int) -> RenderableType:
    """Return a table with a line for each direction that has seen datagrams.

    What there is no room for beside the links' names is left out, the chart first.
    """
    rows = [
        (link, name) for link in statistics["links"] for name in DIRECTIONS if link[name]["arrived"]
    ]
    shown = rows[:lines]
    names = [f" {'→' if name == 'forward' else '←'} {link['name']}" for link, name in shown]
    name_width = min(max(map(len, names), default=0), width // 3)
    columns = {heading: [cell(link[name]) for link, name in shown] for heading, cell in _CELLS}
    widths = {heading: max(map(len, (heading, *cells))) for heading, cells in columns.items()}
    for heading in _LEFT_OUT:
        if name_width + sum(widths.values()) + len(widths) > width:
            del columns[heading], widths[heading]
    chart_width = min(width - name_width - sum(widths.values()) - len(widths) - 1, _CHART_WIDTH)
    has_chart = chart_width >= _LEAST_CHART_WIDTH

    table = Table(box=None, padding=(0, 1, 0, 0), header_style="dim", pad_edge=False)
    table.add_column(" link", no_wrap=True, overflow="ellipsis", width=name_width)
    for heading in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    if has_chart:
        table.add_column("last minute"[:chart_width], no_wrap=True, width=chart_width)
    for row, (link, name) in enumerate(shown):
        cells: list[str | Text] = [column[row] for column in columns.values()]
        if has_chart:
            series = history.series(
                link["name"], name, lambda one: one["arrived_per_s"], chart_width
            )
            cells.append(Text(sparkline(series, _top(series)), "green"))
        of = link[name]
        beyond = of["mansd"] is not None and of["longest_loss_burst"] > of["mansd"]
        bad = beyond or any(of["unintended"].values())
        table.add_row(Text(names[row]), *cells, style="bold red" if bad else "")
    hidden = len(rows) - len(shown)
    return Group(table, Text(f" … and {hidden} more", "dim")) if hidden else table


def _per_s(of: DirectionStatistics, which: Literal["arrived_per_s", "forwarded_per_s"]) -> str:
    return rate_text(of["recent"][which]) if of["recent"] else NONE


_CELLS: Sequence[tuple[str, Callable[[DirectionStatistics], str]]] = (
    ("in", lambda of: _per_s(of, "arrived_per_s")),
    ("out", lambda of: _per_s(of, "forwarded_per_s")),
    ("loss", lambda of: percent_text(of["loss"]["lost"])),
    ("predicted", lambda of: percent_text(of["loss"]["predicted"])),
    (
        "run",
        lambda of: f"{of['longest_loss_burst']:,}/{NONE if of['mansd'] is None else of['mansd']}",
    ),
    ("p99", lambda of: time_text((of["recent"] or of)["delay_ns"]["p99"])),
)
"""A line's columns: heading and text."""
_LEFT_OUT = ("predicted", "p99", "out")
"""In this order, where there is no room."""


def plain_lines(statistics: Statistics) -> list[str]:
    """Return a line of text for each direction that has seen datagrams, for what is no terminal."""
    return [
        _plain_line(statistics["elapsed_s"], link, name)
        for link in statistics["links"]
        for name in DIRECTIONS
        if link[name]["arrived"]
    ]


def _plain_line(elapsed_s: float, link: LinkStatistics, name: Direction) -> str:
    of = link[name]
    recent = of["recent"]
    parts = [f"{elapsed_s:.1f} s", f"{link['name']} {name}"]
    if recent is not None:
        parts += [
            f"in {rate_text(recent['arrived_per_s'])} {bits_text(recent['arrived_bits_per_s'])}",
            f"out {rate_text(recent['forwarded_per_s'])} "
            f"{bits_text(recent['forwarded_bits_per_s'])}",
        ]
    parts.append(f"loss {_loss(of).plain}")
    parts.append(f"drawn {_drawn(of).plain}")
    parts.append(f"run {_run(of, 0).plain}")
    parts.append(f"delay p99 {time_text((recent or of)['delay_ns']['p99'])}")
    parts.append(f"under way {of['in_flight']:,}")
    parts += [f"UNINTENDED {n:,} {cause}" for cause, n in of["unintended"].items() if n]
    return "  ".join(parts)

"""A relay's statistics in the terminal: numbers with units, small charts, and the live screen.

:func:`render` draws a statistics document; :class:`Screen` shows it again and again, and reads the
keys.
"""

import contextlib
import io
import json
import os
import select
import sys
import termios
import textwrap
import tty
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
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
from netem.relay.relay_reports import DIRECTIONS, Direction
from noack.core.number_format import with_unit

_BLOCKS = "▁▂▃▄▅▆▇█"
_NONE = "–"
_BIT_RATES = ("Gbit/s", "Mbit/s", "kbit/s", "bit/s")


def rate_text(per_s: float) -> str:
    """Datagrams per second."""
    return f"{per_s:,.0f}/s" if per_s >= 10 or per_s == 0 else f"{per_s:.2g}/s"


def time_text(t_ns: float | None) -> str:
    """A duration, with three digits."""
    return _NONE if t_ns is None else with_unit(t_ns, ("s", "ms", "µs", "ns"))


def percent_text(share: float | None) -> str:
    """A share in percent, to 0.01 % below 10 %."""
    if share is None:
        return _NONE
    percent = 100 * share
    if percent == 0 or percent >= 99.995:
        return f"{percent:.0f} %"
    if percent < 0.0995:
        return f"{percent:.2g} %"
    return f"{percent:.1f} %" if percent >= 9.995 else f"{percent:.2f} %"


def elapsed_text(elapsed_s: float) -> str:
    """Hours, minutes and seconds."""
    minutes, seconds = divmod(int(elapsed_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def sparkline(values: Sequence[float | None], top: float) -> str:
    """Return one block per value: full height at ``top``, a blank for None."""
    last = len(_BLOCKS) - 1
    return "".join(
        " " if value is None else _BLOCKS[min(max(round(value / (top or 1.0) * last), 0), last)]
        for value in values
    )


def bar(share: float, width: int) -> tuple[str, str]:
    """Return the filled part and the rest of a bar of ``width`` characters."""
    filled = round(min(max(share, 0.0), 1.0) * width)
    return "━" * filled, "─" * (width - filled)


_SPAN_S = 60.0
"""Time that a chart shows."""
_ARROWS = {"forward": "forward →", "reverse": "← reverse"}
_LABEL_WIDTH = 9
_FRAME_WIDTH = 4
_WORDS_LINES = 3
_CHART_WIDTH = 20
_MIN_CHART_WIDTH = 8
_LOST = ("dropped", "corrupted", "overflowed", "blacked_out")


class History:
    """The latest statistics, and the rates of the last minute."""

    def __init__(self) -> None:
        self.latest: Statistics | None = None
        self._samples: defaultdict[tuple[str, Direction], deque[tuple[float, RecentRates]]] = defaultdict(
            deque
        )

    def add(self, statistics: Statistics) -> None:
        """Add statistics that are newer than those before."""
        self.latest = statistics
        now_s = statistics["elapsed_s"]
        for link in statistics["links"]:
            for direction in DIRECTIONS:
                recent = link[direction]["recent"]
                samples = self._samples[link["name"], direction]
                if recent is not None:
                    samples.append((now_s, recent))
                while samples and samples[0][0] <= now_s - _SPAN_S:
                    samples.popleft()

    def series(self, link: str, direction: Direction, key: str, points: int) -> Sequence[float | None]:
        """Return the last minute of a value of :class:`RecentRates`, (points,); None: unknown.

        A sample covers the time since the previous sample. A point is the mean of its samples.
        """
        if self.latest is None:
            return [None] * points
        begin_s = self.latest["elapsed_s"] - _SPAN_S
        width_s = _SPAN_S / points
        by_point: list[list[float]] = [[] for _ in range(points)]
        for end_s, recent in self._samples[link, direction]:
            value: float | None = recent[key]  # type: ignore[literal-required]
            if value is None:
                continue
            first = int(max(end_s - recent["seconds"] - begin_s, 0) / width_s)
            last = min(int((end_s - begin_s) / width_s - 1e-9), points - 1)
            for point in range(first, max(last, first) + 1):
                by_point[min(point, points - 1)].append(value)
        return [sum(values) / len(values) if values else None for values in by_point]


def picture_of(statistics: Statistics, title: str, width: int) -> RenderableType:
    """Return the view of one statistics document, of any height, without the last minute."""
    history = History()
    history.add(statistics)
    return render(history, title, width, None)


def render(history: History, title: str, width: int, height: int | None) -> RenderableType:
    """Return the full-screen view of the latest statistics, for a terminal of this size."""
    latest = history.latest
    if latest is None:
        return Text(f"{title}: waiting for statistics", style="dim")
    heading = Text.assemble((f" {title}", "bold"), (f"  {elapsed_text(latest['elapsed_s'])}", "dim"))
    column = (width - _FRAME_WIDTH - _LABEL_WIDTH - 2) // 2
    panels = [_panel(history, link, column) for link in latest["links"]]
    if height is None or 1 + sum(lines for _, lines in panels) <= height:
        return Group(heading, *(panel for panel, _ in panels))
    return Group(heading, _table(history, latest, width, height - 3))


def _panel(history: History, link: LinkStatistics, column: int) -> tuple[RenderableType, int]:
    """Return a link's panel and its number of lines."""
    grid = Table.grid(padding=(0, 1, 0, 0), pad_edge=False)
    grid.add_column(width=_LABEL_WIDTH, style="dim")
    for _ in DIRECTIONS:
        grid.add_column(width=column)
    lines = 2
    forward, reverse = (_cells(history, link, name, column) for name in DIRECTIONS)
    for (label, forward_text), (_, reverse_text) in zip(forward, reverse, strict=True):
        if not (label + forward_text.plain + reverse_text.plain).strip():  # a chart without data
            continue
        grid.add_row(label, forward_text, reverse_text)
        lines += 1 + max(cell.plain.count("\n") for cell in (forward_text, reverse_text))
    unintended = _unintended_losses(link)
    ends = (link[end].removesuffix(":0") for end in ("listen", "to"))  # a shell's have no port
    title = Text.assemble((link["name"], "bold"), f"  {' → '.join(ends)}  ", (_clients_text(link), "dim"))
    panel = Panel(
        Group(grid, *unintended),
        title=title,
        title_align="left",
        border_style="red" if unintended else "blue",
    )
    return panel, lines + len(unintended)


def _clients_text(link: LinkStatistics) -> str:
    text = f"{link['clients']} client{'' if link['clients'] == 1 else 's'}"
    if link["clients_ever"] > link["clients"]:
        text += f" ({link['clients_ever']} ever)"
    if link["refused"]:
        text += f", {link['refused']:,} datagrams refused"
    if link["port_unreachable"]:
        text += f", port unreachable {link['port_unreachable']:,} times"
    if link["discarded"]:
        text += f", {link['discarded']:,} answers discarded"
    return text


def _unintended_losses(link: LinkStatistics) -> list[Text]:
    """Return the line about unintended losses, if there are any."""
    causes = [
        f"{number:,} {cause.replace('_', ' ')} ({name})"
        for name in DIRECTIONS
        for cause, number in link[name]["unintended"].items()
        if number
    ]
    text = f"unintended losses: {', '.join(causes)}"
    style = "bold white on red"
    return [Text(text, style, no_wrap=True, overflow="ellipsis")] if causes else []


def _cells(
    history: History, link: LinkStatistics, direction: Direction, width: int
) -> list[tuple[str, Text]]:
    """Return the label and the text of each row of a direction."""
    side = link[direction]

    def series(key: str) -> Sequence[float | None]:
        return history.series(link["name"], direction, key, width)

    arrivals, departures = series("received_per_s"), series("forwarded_per_s")
    losses, top = series("loss"), _top([*arrivals, *departures])
    recent, delay, late = side["recent"], side["delay_ns"], side["lateness_ns"]
    if recent is not None and recent["delay_ns"]["p50"] is not None:
        delay, late = recent["delay_ns"], recent["lateness_ns"]
    return [
        ("", Text(_ARROWS[direction], "bold cyan")),
        ("", _wrap(side["words"] or "no impairment", width)),
        ("received", Text(_traffic_text(side, "received"))),
        ("", Text(sparkline(arrivals, top), "green")),
        ("forwarded", Text(_traffic_text(side, "forwarded"))),
        ("", Text(sparkline(departures, top), "green")),
        ("loss", Text(_loss_text(side))),
        ("", Text(sparkline(losses, _top([*losses, side["loss"]["predicted"]])), "yellow")),
        ("drawn", Text(_drawn_text(side))),
        ("lost", _wrap(_lost_text(side), width)),
        ("", _wrap(_further_counts(side), width)),
        ("burst", _burst(side, width)),
        ("delay", Text(_times_text(delay, width))),
        ("lateness", Text(_times_text(late, width))),
        ("in flight", Text(f"{side['in_flight']:,}, max {side['most_in_flight']:,}")),
    ]


def _rate(side: DirectionStatistics, key: str) -> str:
    """Return a recent rate in datagrams per second; without one, the number of datagrams."""
    recent = side["recent"]
    if recent is None:
        return f"{side[key]:,}"  # type: ignore[literal-required]
    return rate_text(recent[f"{key}_per_s"])  # type: ignore[literal-required]


def _traffic_text(side: DirectionStatistics, key: str) -> str:
    """Return :func:`_rate`, and the rate in bits per second."""
    recent = side["recent"]
    bits = "" if recent is None else with_unit(recent[f"{key}_bits_per_s"], _BIT_RATES)  # type: ignore[literal-required]
    return f"{_rate(side, key)}  {bits}".strip()


def _times_text(times: DelayQuantiles, width: int) -> str:
    if times["p50"] is None:
        return _NONE
    text = f"p50 {time_text(times['p50']):<9} p99 {time_text(times['p99'])}"
    return text if len(text) <= width else text.removeprefix("p50 ").replace("  ", " ")


def _top(values: Sequence[float | None]) -> float:
    return max((value for value in values if value is not None), default=0.0)


def _loss_text(side: DirectionStatistics) -> str:
    lost, realised = side["loss"]["lost"], side["loss"]["realised"]
    stale = f", with stale {percent_text(realised)}" if realised != lost else ""
    return percent_text(lost) + stale


def _drawn_text(side: DirectionStatistics) -> str:
    drawn, predicted = side["loss"]["drawn"], side["loss"]["predicted"]
    expected = "" if predicted is None else f", predicted {percent_text(predicted)}"
    return percent_text(drawn) + expected


def _lost_text(side: DirectionStatistics) -> str:
    lost = [(fate.replace("_", " "), side["fates"][fate]) for fate in _LOST]
    lost.append(("stale", side["delivered_out_of_order"]))
    return ", ".join(f"{number:,} {cause}" for cause, number in lost if number) or "0"


def _further_counts(side: DirectionStatistics) -> str:
    counts = {
        "duplicated": side["duplicated"],
        "held back for the guarantee": side["held_back"],
        "received before the last change": side["received_before"],
    }
    return ", ".join(f"{number:,} {title}" for title, number in counts.items() if number)


def burst_text(side: DirectionStatistics) -> str:
    """Return the longest loss burst beside its cap, and the constraints."""
    cap = side["mansd"]
    limits = ["no cap" if cap is None else f"cap {cap:,}", *side["constraints"]]
    return f"{side['longest_loss_burst']:,}, {', '.join(limits)}"


def _burst(side: DirectionStatistics, width: int) -> Text:
    longest, cap, forced = side["longest_loss_burst"], side["mansd"], side["fates"]["forced"]
    text = Text(burst_text(side))
    end = Text(f"  {forced:,} forced", "magenta") if forced else Text()
    room = width - len(text) - len(end) - 2
    if cap is not None and room > 0:
        style = "green" if longest < cap else "yellow" if longest == cap else "bold red"
        filled, unfilled = bar(longest / cap if cap else float(longest > 0), room)
        text.append("  ").append(filled, style).append(unfilled, "dim")
    return text.append_text(end)


def _wrap(text: str, width: int) -> Text:
    return Text("\n".join(textwrap.wrap(text, width, max_lines=_WORDS_LINES, placeholder=" …")))


def _burst_of_cap(side: DirectionStatistics) -> str:
    return f"{side['longest_loss_burst']:,}/{_NONE if side['mansd'] is None else side['mansd']}"


_COLUMNS: dict[str, Callable[[DirectionStatistics], str]] = {
    "received": lambda side: _rate(side, "received"),
    "forwarded": lambda side: _rate(side, "forwarded"),
    "loss": lambda side: percent_text(side["loss"]["lost"]),
    "predicted": lambda side: percent_text(side["loss"]["predicted"]),
    "burst/cap": _burst_of_cap,
    "p99": lambda side: time_text((side["recent"] or side)["delay_ns"]["p99"]),
}
"""Columns of the table: heading and text."""
_OPTIONAL = ("predicted", "p99", "forwarded")
"""Columns that are omitted, in this order, if the terminal is too narrow."""


def _table(history: History, latest: Statistics, width: int, lines: int) -> RenderableType:
    """Return a table with a row for each direction that has received datagrams."""
    rows = _directions_in_use(latest)
    # All texts, so that the widths of the columns are known.
    listed = rows[:lines]
    names = [f" {'→' if name == 'forward' else '←'} {link['name']}" for link, name in listed]
    name_width = min(max(map(len, names), default=0), width // 3)
    columns = {heading: [text(link[name]) for link, name in listed] for heading, text in _COLUMNS.items()}

    def room() -> int:
        widths = [max(map(len, (heading, *texts))) for heading, texts in columns.items()]
        return width - name_width - sum(widths) - len(widths)

    # Leave columns out until the others fit; what is left is for the chart.
    for heading in _OPTIONAL:
        if room() < 0:
            del columns[heading]
    chart_width = min(room() - 1, _CHART_WIDTH)
    if chart_width >= _MIN_CHART_WIDTH:
        series = [history.series(link["name"], name, "received_per_s", chart_width) for link, name in listed]
        columns["last minute"[:chart_width]] = [sparkline(rates, _top(rates)) for rates in series]

    table = Table(box=None, padding=(0, 1, 0, 0), header_style="dim", pad_edge=False)
    table.add_column(" link", no_wrap=True, overflow="ellipsis", width=name_width)
    for heading in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    # A direction that broke its cap, or lost datagrams unintendedly, is red.
    for row, (link, name) in enumerate(listed):
        side = link[name]
        exceeds = side["mansd"] is not None and side["longest_loss_burst"] > side["mansd"]
        style = "bold red" if exceeds or any(side["unintended"].values()) else ""
        table.add_row(Text(names[row]), *(texts[row] for texts in columns.values()), style=style)
    hidden = len(rows) - len(listed)
    return Group(table, Text(f" … and {hidden} more", "dim")) if hidden else table


def _directions_in_use(statistics: Statistics) -> list[tuple[LinkStatistics, Direction]]:
    links = statistics["links"]
    return [(link, name) for link in links for name in DIRECTIONS if link[name]["received"]]


def plain_lines(statistics: Statistics) -> list[str]:
    """Return a line of text for each direction that has received datagrams."""
    return [_plain_line(statistics["elapsed_s"], *row) for row in _directions_in_use(statistics)]


def _plain_line(elapsed_s: float, link: LinkStatistics, name: Direction) -> str:
    side = link[name]
    parts = [
        f"{elapsed_s:.1f} s",
        f"{link['name']} {name}",
        f"received {_traffic_text(side, 'received')}",
        f"forwarded {_traffic_text(side, 'forwarded')}",
        f"loss {_loss_text(side)}",
        f"drawn {_drawn_text(side)}",
        f"longest loss burst {burst_text(side)}",
        f"forced {side['fates']['forced']:,}",
        f"delay p99 {time_text((side['recent'] or side)['delay_ns']['p99'])}",
        f"in flight {side['in_flight']:,}",
    ]
    parts += [f"UNINTENDED {n:,} {cause}" for cause, n in side["unintended"].items() if n]
    return "  ".join(parts)


_MESSAGES_SHOWN = 3


class Screen:
    """Shows statistics within the context; the last picture remains afterwards.

    Messages on standard error are shown below the picture, and written at the end. With ``as_json``
    it prints each document as a line of JSON instead.
    """

    def __init__(self, title: str, *, as_json: bool = False) -> None:
        self._title = title
        self._as_json = as_json
        self._console = Console()
        self._history = History()
        self._live: Live | None = None
        self._size = self._console.size
        self._messages = io.StringIO()
        self._keys = False
        self._stack = ExitStack()
        self.quit_requested = False
        """Whether the user has pressed q."""

    def __enter__(self) -> Self:
        if self._console.is_terminal and not self._console.is_dumb_terminal and not self._as_json:
            live = Live(
                console=self._console,
                screen=True,
                auto_refresh=False,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            with ExitStack() as stack:
                stack.callback(self._leave)
                stack.enter_context(contextlib.redirect_stderr(self._messages))
                self._keys = stack.enter_context(_single_keys())
                self._live = stack.enter_context(live)
                self._stack = stack.pop_all()
            self._draw()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def show(self, statistics: Statistics) -> None:
        """Show new statistics."""
        if self._as_json:
            print(json.dumps(statistics), flush=True)
        elif self._live is None:
            print("\n".join(plain_lines(statistics)), flush=True)
        else:
            self._history.add(statistics)
            self._draw()

    def poll(self) -> None:
        """Read the keyboard, and draw again if the terminal's size has changed."""
        while self._keys and select.select([sys.stdin], (), (), 0)[0]:
            keys = os.read(sys.stdin.fileno(), 64)
            self._keys = bool(keys)
            self.quit_requested |= b"q" in keys.lower()
        if self._live is not None and self._console.size != self._size:
            self._size = self._console.size
            self._draw()

    def _draw(self) -> None:
        assert self._live is not None
        messages = self._messages.getvalue().splitlines()[-_MESSAGES_SHOWN:]
        height = self._console.height - len(messages) - 1
        picture = render(self._history, self._title, self._console.width, height)
        below = [Text(f" {message}", "yellow", no_wrap=True) for message in messages]
        help_line = Text(" q ends" if self._keys else " Ctrl-C ends", "dim")
        self._live.update(Group(picture, *below, help_line), refresh=True)

    def _leave(self) -> None:
        if self._history.latest is not None:
            self._console.print(render(self._history, self._title, self._console.width, None))
        print(self._messages.getvalue(), end="", file=sys.stderr)


@contextlib.contextmanager
def _single_keys() -> Iterator[bool]:
    """Read keys at once and without echo; yield whether there is a keyboard."""
    if not sys.stdin.isatty():
        yield False
        return
    attributes = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield True
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, attributes)

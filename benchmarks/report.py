"""Benchmarks as functions that return rows; rounds, rows and tables."""

import argparse
import json
import operator
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

_COMPARISONS = {"<=": operator.le, "<": operator.lt, ">=": operator.ge, "==": operator.eq}
median = statistics.median


class MeasurementError(Exception):
    """A benchmark could not be measured; the message is the reason, one line.

    Whatever measures may raise it.
    """


class Peer(NamedTuple):
    """The figure of the alternative, measured in the same run."""

    name: str
    value: float | None


class Goal(NamedTuple):
    """A figure to reach."""

    comparison: str
    limit: float

    def __str__(self) -> str:
        return f"{self.comparison} {self.limit:g}"


ZERO = Goal("==", 0)
"""The goal of what must not occur."""


@dataclass(frozen=True)
class Row:
    """One figure."""

    name: str
    value: float | None
    """None if it could not be measured."""
    unit: str
    peer: Peer | None = None
    """The alternative, in the same unit."""
    goal: Goal | None = None
    """A condition on the ratio to the peer; without a peer, on the value."""
    note: str | None = None
    unchecked_because: str | None = None
    """Why the goal cannot be checked although there is a figure."""
    paired_ratio: float | None = None
    """If both sides were measured in turn, the median of the rounds' ratios; replaces the ratio of
    the two figures."""

    @property
    def ratio(self) -> float | None:
        """Ratio of our value to the peer's."""
        if self.paired_ratio is not None:
            return self.paired_ratio
        if self.value is None or self.peer is None or not self.peer.value:
            return None
        return self.value / self.peer.value

    @property
    def holds(self) -> bool | None:
        """Whether the goal was reached; None if there is none or it cannot be checked."""
        figure = self.value if self.peer is None else self.ratio
        if self.goal is None or figure is None or self.unchecked_because is not None:
            return None
        return bool(_COMPARISONS[self.goal.comparison](figure, self.goal.limit))

    @property
    def notes(self) -> str:
        """Why it is not checked, and the note."""
        return "; ".join(filter(None, (self.unchecked_because, self.note)))

    @property
    def cells(self) -> tuple[str, ...]:
        """The row of a table: figure, value, alternative, its value, ratio, goal, verdict."""
        goal = "" if self.goal is None else str(self.goal)
        return (
            self.name,
            with_unit(self.value, self.unit),
            self.peer.name if self.peer else "",
            with_unit(self.peer.value, self.unit) if self.peer else "",
            "" if self.ratio is None else number_text(self.ratio),
            goal,
            {True: "yes", False: "no", None: "?" if goal else ""}[self.holds],
        )

    def to_json(self) -> dict[str, object]:
        """Return the row as ``--json`` writes it."""
        row: dict[str, object] = {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "peer": self.peer and self.peer._asdict(),
            "ratio": self.ratio,
            "goal": self.goal and str(self.goal),
            "holds": self.holds,
        }
        return row | ({"note": self.notes} if self.notes else {})


Measure = Callable[[argparse.Namespace], Iterable[Row]]
Options = Mapping[str, Mapping[str, Any]]
"""The arguments of ``add_argument`` by the option's name."""


class Benchmark(NamedTuple):
    """A benchmark of the command line: its table's title, its function, its own options."""

    name: str
    title: str
    measure: Measure
    options: Options


def option(default: object, text: str, **more: Any) -> dict[str, Any]:
    """Return an option with a default value, whose type is that of the option."""
    return {"type": type(default), "default": default, "help": f"{text} (%(default)s)", **more}


BENCHMARKS: dict[str, Benchmark] = {}


def benchmark(name: str, title: str, options: Options | None = None) -> Callable[[Measure], Measure]:
    """Declare a function that measures a benchmark."""

    def declare(measure: Measure) -> Measure:
        BENCHMARKS[name] = Benchmark(name, title, measure, options or {})
        return measure

    return declare


Figures = Mapping[str, float]
"""The figures of one side in one round, by quantity."""


def quantiles_us(values_ns: Sequence[float] | NDArray[Any]) -> Figures:
    """Return ``p50``, ``p99`` and ``max`` of values in ns, in µs."""
    p50_us, p99_us, max_us = (np.quantile(values_ns, (0.5, 0.99, 1)) / 1e3).tolist()
    return {"p50": p50_us, "p99": p99_us, "max": max_us}


class Rounds:
    """Figures of several sides that are measured in turn, each once per round."""

    def __init__(self) -> None:
        self.missing: dict[str, str] = {}
        """For each side without valid figures, the reason."""
        self._figures = defaultdict[str, list[Figures]](list)

    def add(self, side: str, figures: Figures | str) -> None:
        """Add a side's figures of a round, or the reason why there are none."""
        if isinstance(figures, str):
            self.missing[side] = figures
        else:
            self._figures[side].append(figures)

    def measure_in_turn(
        self, count: int, sides: Mapping[str, Callable[[], Figures | str]], head: str = ""
    ) -> None:
        """Measure the sides in turn, in some rounds; one that fails is missing from then on."""
        for number in range(count):
            announce(f"{head}round {number + 1} of {count}")
            for side in [side for side in sides if side not in self.missing]:
                try:
                    self.add(side, sides[side]())
                except MeasurementError as error:
                    self.add(side, str(error))

    def values(self, side: str, quantity: str) -> list[float]:
        """Return the values of a quantity, one of each round; empty if the side was not measured."""
        return [figures[quantity] for figures in self._figures[side]]

    def row(
        self, name: str, unit: str, quantity: str, ours: str, peer: str | None = None,
        goal: Goal | None = None, *, note: str | None = None, paired: bool = False,
    ) -> Row:  # fmt: skip
        """Return the row of a quantity: the medians of our side and of the alternative's.

        With ``paired``, the ratio is the median of the rounds' ratios, since a disturbance affects
        both sides of a round; else it is the ratio of the medians.
        """
        reasons = [f"{side}: {self.missing[side]}" for side in (ours, peer or "") if side in self.missing]
        value, alternative = self.values(ours, quantity), self.values(peer or "", quantity)
        ratio = None
        if paired and not reasons:
            ratio = median(own / other for own, other in zip(value, alternative, strict=True))
        return Row(
            name,
            median(value) if value else None,
            unit,
            None if peer is None else Peer(peer, median(alternative) if alternative else None),
            goal,
            note,
            "; ".join(reasons) or None,
            ratio,
        )


Side = Callable[[], float]
"""Measures one figure of a side."""


def compare(
    name: str,
    unit: str,
    ours: Side,
    peer: tuple[str, Side] | Peer | None = None,
    goal: Goal | None = None,
    *,
    note: str | None = None,
    unchecked_because: str | None = None,
    rounds: int = 5,
) -> Row:
    """Measure our side and the alternative in turn; the ratio is the median of the rounds' ratios.

    The alternative may also be a known figure.
    """
    announce(name)
    if peer is None or isinstance(peer, Peer):
        return Row(name, median(ours() for _ in range(rounds)), unit, peer, goal, note, unchecked_because)
    pairs = [(ours(), peer[1]()) for _ in range(rounds)]
    value, other = (median(side) for side in zip(*pairs, strict=True))
    ratio = median(a / b for a, b in pairs)
    return Row(name, value, unit, Peer(peer[0], other), goal, note, unchecked_because, ratio)


def cpu_ms(call: Callable[[], object]) -> Side:
    """Return a side: milliseconds of CPU time of a call, which other load changes little."""
    return lambda: 1e3 * _cpu_s(call)


def per_cpu_s(count: float, call: Callable[[], object]) -> Side:
    """Return a side: ``count`` items per second of CPU time of a call."""
    return lambda: count / _cpu_s(call)


def _cpu_s(call: Callable[[], object]) -> float:
    began_s = time.process_time()
    call()
    return max(time.process_time() - began_s, 1e-9)


def announce(text: str) -> None:
    """Print what is being measured."""
    print(f"  {text} ...", file=sys.stderr, flush=True)


def print_table(title: str, rows: Sequence[Row]) -> None:
    """Print the rows as a table, and below it their notes."""
    console = Console()
    if not console.is_terminal:
        console.width = 130
    table = Table(title=title, title_justify="left")
    for heading in ("figure", "value", "alternative", "its value", "ratio", "goal", "holds"):
        right = heading in ("value", "its value", "ratio", "goal")
        table.add_column(heading, justify="right" if right else "left")
    for row in rows:
        style = "bold red" if row.holds is False else None
        table.add_row(*map(escape, row.cells), style=style)
    console.print(table)
    for row in rows:
        if row.notes:
            console.print(f"{row.name}: {row.notes}", highlight=False, markup=False)


def write_json(path: Path, rows: Iterable[dict[str, object]]) -> None:
    """Write rows into a file."""
    path.write_text(json.dumps(list(rows), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def number_text(value: float) -> str:
    """Return a figure with four digits."""
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"


def with_unit(value: float | None, unit: str) -> str:
    """Return a figure with its unit; a dash for None."""
    return "-" if value is None else f"{number_text(value)} {unit}".strip()

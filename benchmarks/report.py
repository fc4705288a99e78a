"""Benchmarks as functions that return rows; their tables."""

import operator
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from inspect import signature
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table

_COMPARISONS = {"<=": operator.le, "<": operator.lt, ">=": operator.ge, "==": operator.eq}


class MeasurementError(Exception):
    """A benchmark could not be measured; the message is the reason, one line."""


class Peer(NamedTuple):
    """The figure of the alternative, measured in the same run."""

    name: str
    value: float | None


class Goal(NamedTuple):
    """A figure to reach."""

    comparison: str
    limit: float
    of_value: bool = False
    """Whether it is one of the value also if there is a peer."""

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
        """Whether the goal was reached; None if there is none or a figure is missing."""
        figure = self.value if self.peer is None or (self.goal and self.goal.of_value) else self.ratio
        if self.goal is None or figure is None:
            return None
        return bool(_COMPARISONS[self.goal.comparison](figure, self.goal.limit))

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
        return {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "peer": self.peer and self.peer._asdict(),
            "ratio": self.ratio,
            "goal": self.goal and str(self.goal),
            "holds": self.holds,
            "note": self.note,
        }


Measure = Callable[..., Iterable[Row]]


class Benchmark(NamedTuple):
    """A benchmark of the command line: its table's title, and its function.

    The function's parameters have defaults of the type of their values.
    """

    name: str
    title: str
    measure: Measure

    @property
    def parameters(self) -> dict[str, Any]:
        """The defaults of its parameters."""
        return {name: one.default for name, one in signature(self.measure).parameters.items()}


BENCHMARKS: dict[str, Benchmark] = {}


def benchmark(name: str, title: str) -> Callable[[Measure], Measure]:
    """Declare a function that measures a benchmark."""

    def declare(measure: Measure) -> Measure:
        BENCHMARKS[name] = Benchmark(name, title, measure)
        return measure

    return declare


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
        if row.note:
            console.print(f"{row.name}: {row.note}", highlight=False, markup=False)


def number_text(value: float) -> str:
    """Return a figure with four digits."""
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"


def with_unit(value: float | None, unit: str) -> str:
    """Return a figure with its unit; a dash for None."""
    return "-" if value is None else f"{number_text(value)} {unit}".strip()

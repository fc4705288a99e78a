"""Rounds, rows, tables and JSON of the benchmarks, and the machine's other load."""

import argparse
import operator
import resource
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import psutil
from rich.table import Table

BUSY_SHARE = 0.1
"""Figures are reported as doubtful if other programs used at least this share of all cores."""
STEAL_SHARE = 0.01
"""Figures are reported as doubtful if the hypervisor took at least this share of all cores."""

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

    def holds(self, found: float) -> bool:
        """Whether ``found`` reaches the goal."""
        return bool(_COMPARISONS[self.comparison](found, self.limit))

    def __str__(self) -> str:
        return f"{self.comparison} {self.limit:g}"


@dataclass(frozen=True)
class Row:
    """One figure.

    Args:
        name: what was measured.
        value: the figure; None if it could not be measured.
        unit: its unit.
        peer: the alternative, in the same unit.
        goal: condition on the ratio to the peer; without a peer, on the value.
        note: a remark for the reader.
        unjudged: why the goal cannot be judged although there is a figure.
        paired_ratio: if both sides were measured in alternating rounds, the median over rounds of
            the ratio within a round; it replaces the ratio of the two figures.
    """

    name: str
    value: float | None
    unit: str
    peer: Peer | None = None
    goal: Goal | None = None
    note: str | None = None
    unjudged: str | None = None
    paired_ratio: float | None = None

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
        """Whether the goal was reached; None if there is none or it cannot be judged."""
        found = self.value if self.peer is None else self.ratio
        if self.goal is None or found is None or self.unjudged is not None:
            return None
        return self.goal.holds(found)

    def as_json(self) -> dict[str, Any]:
        """Return the row as ``--json`` writes it."""
        row = {
            "name": self.name, "value": self.value, "unit": self.unit,
            "peer": self.peer and self.peer._asdict(), "ratio": self.ratio,
            "goal": self.goal and str(self.goal), "holds": self.holds,
        }  # fmt: skip
        notes = [text for text in (self.unjudged, self.note) if text]
        return row | ({"note": "; ".join(notes)} if notes else {})


class Load:
    """The machine's load by other programs since the object's construction."""

    def __init__(self) -> None:
        self._before = self._read()

    def rows(self) -> list[Row]:
        """Return the shares of all cores used by other programs and by the hypervisor."""
        total_s, busy_s, steal_s, own_s = np.subtract(self._read(), self._before).tolist()
        total_s = max(total_s, 1e-9)
        return [
            _share("machine: other programs", max(busy_s - own_s, 0.0) / total_s, BUSY_SHARE),
            _share("machine: steal", steal_s / total_s, STEAL_SHARE),
        ]

    @staticmethod
    def _read() -> tuple[float, ...]:
        """CPU seconds: of all cores, used, taken by the hypervisor; used by this benchmark."""
        times = psutil.cpu_times()._asdict()
        for part in ("guest", "guest_nice"):  # included in the users' time
            times.pop(part, None)
        total_s, steal_s = sum(times.values()), times.get("steal", 0.0)
        busy_s = total_s - steal_s - times["idle"] - times.get("iowait", 0.0)
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return total_s, busy_s, steal_s, sum(one.ru_utime + one.ru_stime for one in used)


def _share(name: str, share: float, doubtful: float) -> Row:
    doubt = "the machine was busy: figures are doubtful" if share > doubtful else None
    return Row(name, 100 * share, "% of all cores", note=doubt)


@dataclass(frozen=True)
class Benchmark:
    """A benchmark of the command line.

    Args:
        name: name of its file.
        title: title of its table.
        measure: runs it and returns its rows.
        add_arguments: declares its own options.
    """

    name: str
    title: str
    measure: Callable[[argparse.Namespace], list[Row]]
    add_arguments: Callable[[argparse.ArgumentParser], None] = lambda parser: None


median = statistics.median
Figures = Mapping[str, float]
"""The figures of one side in one round, by quantity."""


class Rounds:
    """Figures of several sides that are measured in turn, each once per round."""

    def __init__(self) -> None:
        self.missing: dict[str, str] = {}
        """For each side without valid figures, the reason."""
        self._figures: dict[str, list[Figures]] = {}

    def add(self, side: str, figures: Figures | str) -> None:
        """Add a side's figures of a round, or the reason why there are none."""
        if isinstance(figures, str):
            self.missing[side] = figures
        else:
            self._figures.setdefault(side, []).append(figures)

    def of(self, side: str, quantity: str) -> list[float]:
        """Return the rounds of a quantity; empty if the side was not measured."""
        return [figures[quantity] for figures in self._figures.get(side, ())]

    def row(
        self, name: str, unit: str, quantity: str, ours: str, peer: str | None = None,
        goal: Goal | None = None, *, note: str | None = None, paired: bool = False,
    ) -> Row:  # fmt: skip
        """Return the row of a quantity: the medians of both sides.

        Args:
            name: what was measured.
            unit: its unit.
            quantity: key of the figures.
            ours: our side.
            peer: the alternative's side.
            goal: see :class:`Row`.
            note: for the reader.
            paired: use the median of the rounds' ratios, since a disturbance affects both sides of
                a round; False: the ratio of the medians.
        """
        sides = [side for side in (ours, peer) if side is not None]
        reasons = [f"{side}: {self.missing[side]}" for side in sides if side in self.missing]
        value, alternative = self.of(ours, quantity), self.of(peer or "", quantity)
        ratios = []
        if paired and not reasons:
            ratios = [one / other for one, other in zip(value, alternative, strict=True)]
        return Row(
            name, median(value) if value else None, unit,
            None if peer is None else Peer(peer, median(alternative) if alternative else None),
            goal, note, "; ".join(reasons) or None, median(ratios) if ratios else None,
        )  # fmt: skip


Side = Callable[[], float]
"""Measures one figure of a side."""


def compared(
    name: str, unit: str, ours: Side, peer: tuple[str, Side] | Peer | None = None,
    goal: Goal | None = None, *, note: str | None = None, unjudged: str | None = None,
    rounds: int = 5,
) -> Row:  # fmt: skip
    """Measure our side and the alternative in turn; the ratio is the median of the rounds' ratios.

    Args:
        name: what is measured.
        unit: its unit.
        ours: our side.
        peer: name and side of the alternative; or its figure, if it is known.
        goal: see :class:`Row`.
        note: for the reader.
        unjudged: see :class:`Row`.
        rounds: number of rounds.
    """
    say(name)
    if not isinstance(peer, tuple) or isinstance(peer, Peer):
        return Row(name, median(ours() for _ in range(rounds)), unit, peer, goal, note, unjudged)
    found = [(ours(), peer[1]()) for _ in range(rounds)]
    value, other = (median(side) for side in zip(*found, strict=True))
    ratio = median(a / b for a, b in found)
    return Row(name, value, unit, Peer(peer[0], other), goal, note, unjudged, ratio)


def cpu_ms(call: Callable[[], object]) -> Side:
    """Return a side: milliseconds of CPU time of a call, which other load changes little."""
    return lambda: 1e3 * _cpu_s(call)


def per_cpu_s(count: float, call: Callable[[], object]) -> Side:
    """Return a side: so many per second of CPU time."""
    return lambda: count / _cpu_s(call)


def _cpu_s(call: Callable[[], object]) -> float:
    begun_s = time.process_time()
    call()
    return max(time.process_time() - begun_s, 1e-9)


def say(text: str) -> None:
    """Print what is being measured."""
    print(f"  {text} ...", file=sys.stderr, flush=True)


def table_of(title: str, rows: Sequence[Row]) -> Table:
    """Return the rows as a table."""
    table = Table(title=title, title_justify="left")
    for heading in ("figure", "value", "alternative", "its value", "ratio", "goal", "holds"):
        right = heading in ("value", "its value", "ratio", "goal")
        table.add_column(heading, justify="right" if right else "left")
    for row in rows:
        goal = "" if row.goal is None else str(row.goal)
        holds = {True: "[green]yes[/]", False: "[bold red]no[/]", None: "?" if goal else ""}
        table.add_row(
            row.name, f"{number_text(row.value)} {row.unit}",
            "" if row.peer is None else row.peer.name,
            "" if row.peer is None else f"{number_text(row.peer.value)} {row.unit}",
            "" if row.ratio is None else number_text(row.ratio),
            goal, holds[row.holds],
        )  # fmt: skip
    return table


def number_text(value: float | None) -> str:
    """Return a figure with four digits; a dash for None."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"

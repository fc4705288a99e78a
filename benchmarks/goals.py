"""The figures that the project wants to reach, each from the row of a benchmark.

``python -m benchmarks goals`` runs the benchmarks that have these rows, prints the figures in this
order, and with ``--docs docs/benchmarks.md`` writes them into the page, between two marks.
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks._report import MeasurementError, Row, number_text

BEGIN, END = "<!-- goals: written by `python -m benchmarks goals --docs` -->", "<!-- goals: end -->"
_HEAD = (
    "| figure | value | alternative in the same run | ratio | goal | holds |\n" + "|---" * 6 + "|"
)


class Figure(NamedTuple):
    """A figure of the table: the rows of a benchmark whose whole names match."""

    benchmark: str
    rows: str
    """A regular expression."""
    name: str = ""
    """Replaces the row's name."""


FIGURES = (
    Figure("latency", r"event → update, .*, p(50|99)"),
    Figure("startup", "noack run → first control step", "`noack run` to the first control step"),
    Figure("startup", "the first run of 20 loops, .*"),
    Figure("clone", "make demo.*"),
    Figure("simulation", ".* of the machines in virtual time", "the demo's 20 s in virtual time"),
    Figure("long_run", "the same, by CPU time .*", "end of a run of 10 minutes, by CPU time"),
    Figure("long_run", "of it, the replay"),
    Figure("simulation", "replay of .*", "replay of 10 minutes at 500 Hz, from memory"),
    Figure("long_run", "peak memory, .*"),
    Figure("fleet", ".*: end of the run"),
    Figure("fleet", ".*lateness p99, worst loop"),
    Figure("fleet", ".*: CPU time per loop and step"),
    Figure("simulation", ".*loops × runs of .*"),
    Figure("batch", "lane_following, .*"),
    Figure("simulation", "sampled runs.*"),
    Figure("relays", "ours.*: drained"),
    Figure("relay_delay", ".*added one way, p50"),
    Figure("relay_flows", ".*reverse direction.*: cost"),
    Figure("fleet", ".*: private memory of .*"),
    Figure("size", ".*"),
)
BENCHMARKS = tuple(dict.fromkeys(figure.benchmark for figure in FIGURES))


def rows_of_figures(rows: Sequence[tuple[str, Row]]) -> list[tuple[str, Row]]:
    """Return name and row of each figure that has a goal, from (benchmark, row), in order."""
    found = []
    for figure in FIGURES:
        for benchmark, row in rows:
            is_its = benchmark == figure.benchmark and re.fullmatch(figure.rows, row.name)
            if is_its and (row.goal is not None or row.value is None):
                found.append((figure.name or row.name, row))
    return found


def as_markdown(figures: Iterable[tuple[str, Row]]) -> str:
    """Return the table of the page."""
    lines = [_HEAD]
    for name, row in figures:
        peer = "" if row.peer is None else f"{row.peer.name}, {_value(row.peer.value, row.unit)}"
        ratio = "" if row.ratio is None else number_text(row.ratio)
        holds = {True: "yes", False: "no", None: "" if row.goal is None else "?"}[row.holds]
        goal = "" if row.goal is None else str(row.goal)
        cells = (name, _value(row.value, row.unit), peer, ratio, goal, holds)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def write_docs(page: Path, figures: Iterable[tuple[str, Row]]) -> None:
    """Replace the table of a page.

    Raises:
        MeasurementError: the page has not the two marks.
    """
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise MeasurementError(f"{page}: the marks of the table are missing")
    table = as_markdown(figures)
    page.write_text(f"{before}{begin}\n{table}\n{end}{after}", encoding="utf-8")


def _value(value: float | None, unit: str) -> str:
    return "not measured" if value is None else f"{number_text(value)} {unit}".strip()

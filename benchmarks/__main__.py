"""Benchmarks, one table each: ``python -m benchmarks [NAME ...] [--json FILE]``.

The modules in ``cases/`` declare them (:func:`benchmarks.report.benchmark`). ``--list`` lists
them. The name ``goals`` stands for those with the goals of the project (:data:`GOAL_ROWS`);
their rows are printed once more at the end, and ``--docs docs/benchmarks.md`` writes them into
the page, between two marks.
"""

import argparse
import os
import pkgutil
import re
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from benchmarks import cases
from benchmarks.machine_load import MachineLoad
from benchmarks.report import BENCHMARKS, Benchmark, MeasurementError, Row, print_table, write_json
from noack.core.errors import NoackError

GOALS = "goals"
BEGIN, END = "<!-- goals: written by `python -m benchmarks goals --docs` -->", "<!-- goals: end -->"
_HEAD = "| figure | value | alternative in the same run | ratio | goal | holds |\n" + "|---" * 6 + "|"


class GoalRow(NamedTuple):
    """Rows of the goals: those of a benchmark whose whole names match."""

    benchmark: str
    rows: str
    """A regular expression."""
    name: str = ""
    """Replaces the row's name."""

    def matches(self, row: Row) -> bool:
        """Whether a row of the benchmark has a matching name."""
        return re.fullmatch(self.rows, row.name) is not None


GOAL_ROWS = (
    GoalRow("latency", r"event → update, .*, p(50|99)"),
    GoalRow("startup", "noack run → first control step", "`noack run` to the first control step"),
    GoalRow("startup", "the first run of 20 loops, .*"),
    GoalRow("clone", "make demo.*"),
    GoalRow("simulation", ".* of the machines in virtual time", "the demo's 20 s in virtual time"),
    GoalRow("long_run", "the same, by CPU time .*", "end of a run of 10 minutes, by CPU time"),
    GoalRow("long_run", "of it, the replay"),
    GoalRow("simulation", "replay of .*", "replay of 10 minutes at 500 Hz, from memory"),
    GoalRow("long_run", "peak memory, .*"),
    GoalRow("many_loops", ".*: end of the run"),
    GoalRow("many_loops", ".*lateness p99, worst loop"),
    GoalRow("many_loops", ".*: CPU time per loop and step"),
    GoalRow("simulation", ".*loops × runs of .*"),
    GoalRow("batch", "lane_following, .*"),
    GoalRow("simulation", "sampled runs.*"),
    GoalRow("relays", "ours.*: drained"),
    GoalRow("relay_delay", ".*added one way, p50"),
    GoalRow("relay_flows", ".*reverse direction.*: cost"),
    GoalRow("many_loops", ".*: private memory of .*"),
    GoalRow("size", ".*"),
)
OF_GOALS = tuple(dict.fromkeys(goal_row.benchmark for goal_row in GOAL_ROWS))


def all_benchmarks() -> Mapping[str, Benchmark]:
    """Return all benchmarks by name."""
    for module in pkgutil.iter_modules(cases.__path__):
        import_module(f"{cases.__name__}.{module.name}")
    return dict(sorted(BENCHMARKS.items()))


def run(benchmarks: Mapping[str, Benchmark], arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 if all could be measured and all goals have rows."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--list", action="store_true", help="list the benchmarks, and end")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="write the goals into this page")
    names = f"of {', '.join(benchmarks)}; {GOALS}: {', '.join(OF_GOALS)}"
    parser.add_argument("names", nargs="*", metavar="NAME", help=names)
    for benchmark in benchmarks.values():
        for option, settings in benchmark.options.items():
            parser.add_argument(option, **settings)
    options = parser.parse_args(arguments)
    if options.list:
        print("\n".join(f"{benchmark.name:<20}{benchmark.title}" for benchmark in benchmarks.values()))
        return 0
    if options.docs is not None and GOALS not in options.names:
        parser.error(f"--docs writes the rows of all goals: it needs the name {GOALS!r}")
    requested = options.names or [*benchmarks]
    chosen = [name for entry in requested for name in (OF_GOALS if entry == GOALS else (entry,))]
    if unknown := [name for name in chosen if name not in benchmarks]:
        parser.error(f"no benchmark {unknown[0]!r}; benchmarks: {', '.join(benchmarks)}")
    rows, failures = list[tuple[str, Row]](), 0
    for benchmark in (benchmark for name, benchmark in benchmarks.items() if name in chosen):
        rows_of_one, failed = _measure(benchmark, options)
        rows += [(benchmark.name, row) for row in rows_of_one]
        lost_goals = [] if failed else goals_without_row(benchmark.name, rows_of_one)
        for goal_row in lost_goals:
            print(f"{benchmark.name}: no row is named like the goal {goal_row.rows!r}", file=sys.stderr)
        failures += failed or bool(lost_goals)
    if options.json is not None:
        write_json(options.json, (row.to_json() | {"benchmark": name} for name, row in rows))
    goals = rows_of_goals(rows)
    if GOALS in requested:
        print_table("The goals", [row for _, row in goals])
    if options.docs is not None:
        try:
            write_docs(options.docs, goals)
        except MeasurementError as error:
            print(error, file=sys.stderr)
            return 1
    return 1 if failures else 0


def _measure(benchmark: Benchmark, options: argparse.Namespace) -> tuple[list[Row], bool]:
    """Run a benchmark and print its table; return its rows, and whether it failed."""
    print(f"{benchmark.name}:", file=sys.stderr)
    load, began_s, failed = MachineLoad(), time.monotonic(), False
    try:
        rows = [*benchmark.measure(options)]
    except (MeasurementError, NoackError, AssertionError) as error:  # assertions of the tests' helpers
        failed = True
        rows = [Row(benchmark.name, None, "", unchecked_because=f"could not be measured: {error}")]
    rows += [*load.rows()]
    print_table(f"{benchmark.title} ({time.monotonic() - began_s:.0f} s)", rows)
    return rows, failed


def rows_of_goals(rows: Sequence[tuple[str, Row]]) -> list[tuple[str, Row]]:
    """Return name and row of each goal, from (benchmark, row), in order."""
    return [
        (goal_row.name or row.name, row)
        for goal_row in GOAL_ROWS
        for benchmark, row in rows
        if benchmark == goal_row.benchmark
        and goal_row.matches(row)
        and (row.goal is not None or row.value is None)
    ]


def goals_without_row(benchmark: str, rows: Sequence[Row]) -> list[GoalRow]:
    """Return the goals of a benchmark that match none of its rows, as after a row was renamed."""
    return [
        goal_row
        for goal_row in GOAL_ROWS
        if goal_row.benchmark == benchmark and not any(map(goal_row.matches, rows))
    ]


def write_docs(page: Path, goals: Iterable[tuple[str, Row]]) -> None:
    """Replace the table of a page."""
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise MeasurementError(f"{page}: the marks of the table are missing")
    lines = [_HEAD]
    for name, row in goals:
        _, value, *peer, ratio, goal, holds = row.cells
        alternative = ", ".join(filter(None, peer))
        cells = (name, "not measured" if row.value is None else value, alternative, ratio, goal)
        lines.append(f"| {' | '.join((*cells, holds))} |")
    table = "\n".join(lines)
    page.write_text(f"{before}{begin}\n{table}\n{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(run(all_benchmarks()))

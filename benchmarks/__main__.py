"""Benchmarks, one table each: ``python -m benchmarks [NAME ...] [--json FILE]``.

Each file of this folder that declares a ``BENCHMARK`` is one, except those that begin with an
underscore, which are parts and programs of others. ``--list`` lists them; the name ``goals`` stands
for all that have the figures of ``goals.py``.
"""

import argparse
import json
import pkgutil
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from rich.console import Console

from benchmarks import goals
from benchmarks._programs import provide
from benchmarks._report import Benchmark, Load, MeasurementError, Row, table_of

GOALS = "goals"
_TABLE_WIDTH = 130
"""Columns of a table, if the output is not a terminal."""


def all_benchmarks() -> list[Benchmark]:
    """Return the benchmarks of this folder."""
    names = (found.name for found in pkgutil.iter_modules([str(Path(__file__).parent)])
             if not (found.ispkg or found.name.startswith("_")))  # fmt: skip
    modules = (import_module(f"benchmarks.{name}") for name in names)
    return [module.BENCHMARK for module in modules if hasattr(module, "BENCHMARK")]


def run(every: Sequence[Benchmark], arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 if all could be measured."""
    benchmarks = {benchmark.name: benchmark for benchmark in every}
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--list", action="store_true", help="list the benchmarks, and end")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="write the goals into this page")
    names = f"of {', '.join(benchmarks)}; {GOALS}: {', '.join(goals.BENCHMARKS)}"
    parser.add_argument("names", nargs="*", metavar="NAME", help=names)
    for benchmark in benchmarks.values():
        benchmark.add_arguments(parser)
    options = parser.parse_args(arguments)
    if options.list:
        print("\n".join(f"{one.name:<20}{one.title}" for one in benchmarks.values()))
        return 0
    asked = options.names or [*benchmarks]
    chosen = [name for one in asked for name in (goals.BENCHMARKS if one == GOALS else (one,))]
    if unknown := [name for name in chosen if name not in benchmarks]:
        parser.error(f"no benchmark {unknown[0]!r}; benchmarks: {', '.join(benchmarks)}")
    console = Console()
    if not console.is_terminal:
        console.width = _TABLE_WIDTH
    rows, failures = list[tuple[str, Row]](), 0
    for benchmark in (benchmark for name, benchmark in benchmarks.items() if name in chosen):
        found, failed = _measured(benchmark, options, console)
        rows += [(benchmark.name, row) for row in found]
        failures += failed
    if options.json is not None:
        content = [row.as_json() | {"benchmark": name} for name, row in rows]
        options.json.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    figures = goals.rows_of_figures(rows)
    if GOALS in asked:
        console.print(table_of("The goals", [row for _, row in figures]))
    if options.docs is not None:
        try:
            goals.write_docs(options.docs, figures)
        except MeasurementError as error:
            print(error, file=sys.stderr)
            return 1
    return 1 if failures else 0


def _measured(
    benchmark: Benchmark, options: argparse.Namespace, console: Console
) -> tuple[list[Row], bool]:
    """Run a benchmark and print its table; return its rows, and whether it failed."""
    print(f"{benchmark.name}:", file=sys.stderr)
    load, begun_s, failed = Load(), time.monotonic(), False
    try:
        rows = benchmark.measure(options)
    except MeasurementError as error:
        failed = True
        rows = [Row(benchmark.name, None, "", unjudged=f"could not be measured: {error}")]
    rows += load.rows()
    console.print(table_of(f"{benchmark.title} ({time.monotonic() - begun_s:.0f} s)", rows))
    for row in rows:
        if (note := row.as_json().get("note")) is not None:
            console.print(f"{row.name}: {note}", highlight=False, markup=False)
    return rows, failed


if __name__ == "__main__":
    if "--list" not in sys.argv:
        provide()
    sys.exit(run(all_benchmarks()))

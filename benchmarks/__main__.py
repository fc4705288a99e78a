"""Benchmarks, one table each: ``python -m benchmarks [NAME ...] [--json FILE]``.

The modules in ``cases/`` declare them (:func:`benchmarks.report.benchmark`). ``--list`` lists them,
with the parameters that ``--set`` changes. Without a name, all but the soak are measured. The name
``goals`` stands for :data:`GOALS`; their rows that have a goal are printed once more at the end, and
``--docs docs/benchmarks.md`` writes them into the page, between two marks.
"""

import argparse
import json
import os
import pkgutil
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NoReturn

# Set before numpy is imported, as the command line does: small matrices do not gain from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from benchmarks import cases
from benchmarks.machine_load import MachineLoad
from benchmarks.report import BENCHMARKS, Benchmark, MeasurementError, Row, print_table
from netem.core.command_line import Parser
from netem.core.errors import NoackError, why
from netem.core.file_access import write_whole

GOALS = (
    "latency", "startup", "simulation", "long_run", "many_loops", "batch", "relays", "relay_delay",
    "relay_flows",
)  # fmt: skip
"""The benchmarks with the goals of the project, in the order of the page."""
BEGIN, END = "<!-- goals: written by `python -m benchmarks goals --docs` -->", "<!-- goals: end -->"
_HEAD = "| figure | value | alternative in the same run | ratio | goal | holds |\n" + "|---" * 6 + "|"


def all_benchmarks() -> Mapping[str, Benchmark]:
    """Return all benchmarks by name."""
    for module in pkgutil.iter_modules(cases.__path__):
        import_module(f"{cases.__name__}.{module.name}")
    return dict(sorted(BENCHMARKS.items()))


class _Parser(Parser):
    """A parser that takes an option once, and prints usage and ends after a mistake."""

    def error(self, message: str) -> NoReturn:
        """Print usage and the mistake, and end with status 2."""
        argparse.ArgumentParser.error(self, message)


def run(benchmarks: Mapping[str, Benchmark], arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 if all could be measured."""
    parser = _Parser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--list", action="store_true", help="list the benchmarks, and end")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE")
    parser.add_argument("--docs", type=Path, metavar="FILE", help="write the goals into this page")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="set a parameter")
    names = f"of {', '.join(benchmarks)}; goals: {', '.join(GOALS)}"
    parser.add_argument("names", nargs="*", metavar="NAME", help=names)
    options = parser.parse_args(arguments)
    if options.list:
        for benchmark in benchmarks.values():
            settings = [f"{name}={default}" for name, default in benchmark.parameters.items()]
            print(f"{benchmark.name:<20}{benchmark.title}", *settings, sep="; ")
        return 0
    if options.docs is not None and "goals" not in options.names:
        parser.error("--docs writes the rows of all goals: it needs the name 'goals'")
    requested = options.names or [name for name in benchmarks if name != "soak"]
    chosen = {name for entry in requested for name in (GOALS if entry == "goals" else (entry,))}
    if unknown := chosen - benchmarks.keys():
        parser.error(f"no benchmark {min(unknown)!r}; benchmarks: {', '.join(benchmarks)}")
    defaults = {key: value for name in chosen for key, value in benchmarks[name].parameters.items()}
    values = dict[str, object]()
    for setting in options.set:
        key, _, text = setting.partition("=")
        try:
            values[key] = type(defaults[key])(text)
        except (KeyError, ValueError):
            parser.error(f"--set {setting}: expected NAME=VALUE of {', '.join(defaults) or 'none'}")
    rows, failures = dict[str, list[Row]](), 0
    for name in sorted(chosen):
        rows[name], failed = _measure(benchmarks[name], values)
        failures += failed
    if options.json is not None:
        content = [row.to_json() | {"benchmark": name} for name in rows for row in rows[name]]
        write_whole(options.json, json.dumps(content, indent=2, allow_nan=False) + "\n")
    if "goals" in requested:
        print_table("The goals", rows_of_goals(rows))
    if options.docs is not None:
        write_docs(options.docs, rows_of_goals(rows))
    return 1 if failures else 0


def _measure(benchmark: Benchmark, values: Mapping[str, object]) -> tuple[list[Row], bool]:
    """Run a benchmark and print its table; return its rows, and whether it failed."""
    print(f"{benchmark.name}:", file=sys.stderr)
    load, began_s, rows, failed = MachineLoad(), time.monotonic(), list[Row](), False
    try:
        given = {name: value for name, value in values.items() if name in benchmark.parameters}
        rows += benchmark.measure(**given)
    except (MeasurementError, NoackError, AssertionError) as error:  # assertions of the tests' helpers
        failed = True
        rows.append(Row(benchmark.name, None, "", note=f"could not be measured: {error}"))
    rows += load.rows()
    print_table(f"{benchmark.title} ({time.monotonic() - began_s:.0f} s)", rows)
    return rows, failed


def rows_of_goals(rows: Mapping[str, Sequence[Row]]) -> list[Row]:
    """Return the rows with a goal, and those that could not be measured, from those by benchmark."""
    return [row for name in GOALS for row in rows.get(name, ()) if row.goal is not None or row.value is None]


def write_docs(page: Path, goals: Iterable[Row]) -> None:
    """Replace the table of a page."""
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise SystemExit(f"{page}: the marks of the table are missing")
    lines = [_HEAD]
    for row in goals:
        name, value, *peer, ratio, goal, holds = row.cells
        alternative = ", ".join(filter(None, peer))
        cells = (name, "not measured" if row.value is None else value, alternative, ratio, goal)
        lines.append(f"| {' | '.join((*cells, holds))} |")
    table = "\n".join(lines)
    write_whole(page, f"{before}{begin}\n{table}\n{end}{after}")


if __name__ == "__main__":
    try:
        found = all_benchmarks()
    except ModuleNotFoundError as error:  # the tests' helpers need it
        sys.exit(f"{error}; `make setup-dev` installs what the benchmarks need")
    try:
        status = run(found)
        sys.stdout.flush()
    except NoackError as error:
        sys.exit(str(error))
    except OSError as error:
        sys.exit(f"cannot write: {why(error)}")
    sys.exit(status)

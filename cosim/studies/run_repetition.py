"""The repetition of an archived run, and what differs, as a result and as a table."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.text import Text

from cosim.analysis.replay import replay
from cosim.analysis.replay.replay_result import difference, rows_differ
from cosim.analysis.summary_model import ReplayDifference
from cosim.live.finalize import finalize, reopen
from cosim.live.simulated_run import simulate_run
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.output.run_tables import network_rows
from cosim.record.record_source import Slice
from cosim.record.run_directory import SCENARIO_FILE, Kind, all_changes_since, kind_of
from cosim.record.run_record import RecordedRun, RunRecord, load_run, steps_of
from cosim.studies.run_archive import MANIFEST, outside_files, unpack
from cosim.studies.run_comparison import compare_runs
from noack.config.scenario import Scenario, loops_of
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import CallerError, MachineError, printable, why
from noack.core.number_format import number
from noack.settings.user_files import file_tables

_MOST_STEPS = 1_000_000
_US_PER_STEP = 100.0
"""Of simulation, record, summary and comparison together."""


class Repetition(NamedTuple):
    """The repetition of an archived run."""

    scenario: str
    kind: Kind
    """Of the archived run. A live one is replayed; its simulation is shown beside it."""
    compared: int
    """Rows of a simulated run, inputs of a live one, that were compared bit for bit."""
    differences: Sequence[str]
    """The first difference of the run and of each of its loops, with table, row, column, values."""
    gaps: Sequence[str]
    """Parts of a live run's record that are missing."""
    changes: Sequence[str]
    """Versions and machine that differ from those of the archived run."""
    numbers: Sequence[tuple[str, ...]]
    """Key numbers that differ: name, archived, repeated; of a live run, those of its simulation."""

    @property
    def bit_exact(self) -> bool:
        """Whether something was compared, and nothing differs in any bit."""
        return bool(self.compared) and not self.differences

    def to_json(self) -> dict[str, Any]:
        """Return the result for programs."""
        found = self._asdict() | {"numbers": [list(row) for row in self.numbers]}
        return {"bit_exact": self.bit_exact, **found}


def repeat_archive(
    path: Path, *, run_code: bool = False, long: bool = False, into: Path | None = None
) -> Repetition:
    """Unpack an archive, repeat its run, and compare.

    Args:
        path: the archive.
        run_code: whether to execute the files of plants, triggers and controllers that it contains.
        long: repeat a run of more than a million steps, too.
        into: folder, new or empty, for the unpacked run and its repetition; else they are deleted.

    Raises:
        CallerError: the file is not an archive, is damaged, or contains code without ``run_code``
            or a long run without ``long``.
        MachineError: a folder cannot be written.
    """
    with _folder(into) as folder:
        archived = folder / "archived"
        manifest = unpack(path, archived)
        scenario = _scenario(path, archived, run_code=run_code)
        if (manifest.scenario, manifest.kind) != (scenario.name, kind_of(archived)):
            raise CallerError(f"{path}: {MANIFEST} describes another run than the archive contains")
        if not long and (steps := steps_of(scenario)) > _MOST_STEPS:
            raise CallerError(
                f"{path}: its run has {steps:,} steps, and would take about "
                f"{steps * _US_PER_STEP * 1e-6 / 3600:.1f} hours; --long repeats it nevertheless"
            )
        try:
            recorded = load_run(archived)
        except CallerError as error:
            raise CallerError(f"{path}: {str(error).removeprefix(f'{archived}/')}") from None
        ending = simulate_run(scenario, folder / "repeated")
        finalize(ending, report=False, view=False)
        repeated = load_run(ending.run_dir)
        compare = _replayed if manifest.kind == "live" else _repeated
        pairs = zip(_named(recorded), _named(repeated), strict=True)
        found = [compare(name, one, other) for (name, one), (_, other) in pairs]
        return Repetition(
            scenario=manifest.scenario,
            kind=manifest.kind,
            compared=sum(one.compared for one in found),
            differences=[text for one in found for text in one.differences],
            gaps=[text for one in found for text in one.gaps],
            changes=all_changes_since(archived),
            numbers=_numbers(archived, ending.run_dir),
        )


class _Compared(NamedTuple):
    compared: int
    differences: Sequence[str]
    gaps: Sequence[str]


@contextmanager
def _folder(into: Path | None) -> Iterator[Path]:
    if into is None:
        with tempfile.TemporaryDirectory(prefix="noack-") as temporary:
            yield Path(temporary)
        return
    try:
        into.mkdir(parents=True, exist_ok=True)
        if any(into.iterdir()):
            raise CallerError(f"--into {into}: the folder is not empty")
    except OSError as error:
        raise MachineError(f"{into}: {why(error)}") from None
    yield into


def _scenario(path: Path, archived: Path, *, run_code: bool) -> Scenario:
    """Load the scenario of an unpacked archive; refuse code that is not wanted, or elsewhere."""
    if not (archived / SCENARIO_FILE).is_file():
        raise CallerError(f"{path}: not an archive of a run: has no {SCENARIO_FILE}")
    scenario = load(archived / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    if (outside := outside_files(scenario, archived)) is not None:
        raise CallerError(f"{path}: its scenario names {outside}, which is not in the archive")
    for one in (scenario, *loops_of(scenario)):
        for place, table in file_tables(one):
            if not run_code:
                name = Path(table.file or "").name
                raise CallerError(
                    f"{path}: contains code ({place}: {name}), which would be run with your "
                    "permissions; --run-code runs it"
                )
    return scenario


def _named(run: RecordedRun) -> Iterator[tuple[str, RunRecord]]:
    """Yield the records of the loops with their names, and that of a network that they share."""
    if len(run.loops) == 1:  # its record has the rows of the network
        yield "", run.loops[0]
        return
    yield "", run.network
    for name, record in zip(run.names, run.loops, strict=True):
        yield f"loop {name}: ", record


def _replayed(name: str, archived: RunRecord, _: RunRecord) -> _Compared:
    found = replay(archived)
    first = found.first_difference
    gaps = [f"{name}{gap}" for gap in found.gaps]
    return _Compared(found.inputs, [] if first is None else [f"{name}{first}"], gaps)


def _repeated(name: str, archived: RunRecord, repeated: RunRecord) -> _Compared:
    first = first_difference(archived, repeated)
    count = sum(archived.count(table) for table in archived.tables)
    return _Compared(count, [] if first is None else [f"{name}{first}"], [])


def first_difference(one: RunRecord, other: RunRecord) -> ReplayDifference | None:
    """Return the first difference between the tables of two records, bit for bit."""
    before = dict.fromkeys(one.tables, 0)
    nothing: Slice = {}
    for recorded, again in zip_longest(one.slices(), other.slices(), fillvalue=nothing):
        found = [
            different
            for table in one.tables
            if (different := _in_table(table, before[table], recorded, again)) is not None
        ]
        if found:
            return min(found, key=lambda each: each.now_ns)
        for table in one.tables:
            before[table] += len(recorded[table])
    return None


def _in_table(table: str, before: int, recorded: Slice, again: Slice) -> ReplayDifference | None:
    rows, others = (part.get(table, np.zeros(0)) for part in (recorded, again))
    if rows.tobytes() == others.tobytes():
        return None
    for i, (row, other) in enumerate(zip(rows, others, strict=False)):
        if row.tobytes() != other.tobytes():
            return rows_differ(table, before + i, row, other)
    common, longer = min(len(rows), len(others)), max(rows, others, key=len)
    what = "the row is missing in the " + ("repetition" if len(rows) > common else "archive")
    return difference(table, before + common, int(longer[common]["now_ns"]), what)


def _numbers(archived: Path, repeated: Path) -> list[tuple[str, ...]]:
    """Return the key numbers that differ, as text."""
    summaries = [reopen(one, view=False).summary for one in (archived, repeated)]
    if len(summaries[0].loops) > 1:
        first, second = (dict(network_rows(one)) for one in summaries)
        rows = [(name, value, second.get(name, "-")) for name, value in first.items()]
        return [row for row in rows if row[1] != row[2]]
    return [
        (key.name, *(number(value, 6) for value in key.values))
        for key in compare_runs([archived, repeated]).numbers
        if key.values[0] != key.values[1] and key.values != (None, 0.0)  # a distance of 0
    ]


def print_repetition(console: Console, found: Repetition) -> None:
    """Print what was compared, and what differs: bits, numbers, versions and machine.

    Texts of the archive are printed without control characters.
    """

    def say(text: str, style: str = "") -> None:
        console.print(Text(printable(text), style), soft_wrap=True)

    what = "inputs replayed" if found.kind == "live" else "rows repeated"
    verdict = ("bit-exact", "green") if found.bit_exact else ("not reproduced", "bold red")
    if not found.compared:
        verdict = "nothing to compare", "bold red"
    say(f"{found.scenario}, {found.kind}: {verdict[0]}, {found.compared:,} {what}", verdict[1])
    for text in found.differences:
        say(f"first difference: {text}")
    for text in found.gaps:
        say(f"record incomplete: {text}", "yellow")
    if found.numbers:
        late = ": the simulation has no lateness" if found.kind == "live" else ""
        rows = [[*map(printable, row)] for row in found.numbers]
        heads = ("quantity", "archived", "repeated")
        table = ResultTable("numbers", f"numbers that differ{late}", heads, rows)
        console.print(terminal_table(table))
    for change in found.changes:
        say(f"differs from the archived run's machine: {change}")

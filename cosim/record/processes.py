"""The processes of a run: their final reports, and their generations.

The reports are written as one file, and read back with care. A generation is a process between two
restarts; :func:`read_generations` finds out which of its rows are recorded, and when it was active.
"""

import contextlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.record_source import RecordSource, Rows, Slice
from cosim.record.run_directory import REPORTS_FILE, read_object
from noack.core.errors import PeerError
from noack.core.file_access import write_whole
from noack.protocol.record_tables import OWNER, network_tables
from noack.protocol.roles import GENERATION, LOOP_ROLES
from noack.runtime.control_messages import ProcessReport, parse_message
from noack.runtime.spool import KEPT_REPORT, SPOOL, read_batches

_EARLIER = "earlier"
Report = dict[str, Any]
"""A process's final report: the fields of :class:`ProcessReport`, with ``process``."""


def report_of(role: str, text: bytes | str, tables: Iterable[str]) -> ProcessReport:
    """Return a process's final report from its JSON.

    Raises:
        PeerError: the text is no report, or has no entry for a table of the process.
    """
    report = parse_message(ProcessReport, text)
    if not report.rows.keys() >= {table for table in tables if OWNER[table] == role}:
        raise PeerError("the report lacks the number of rows of a table")
    return report


def write_reports(run_dir: Path, reports: Iterable[Report]) -> None:
    """Write the final reports of all processes; each has the key ``process``.

    Raises:
        MachineError: they cannot be written.
    """
    in_order = sorted(reports, key=lambda report: int(report["generation"]))
    newest = {report["process"]: report for report in in_order}
    earlier = [report for report in in_order if report is not newest[report["process"]]]
    content = newest | ({_EARLIER: earlier} if earlier else {})
    # A run directory that was deleted meanwhile is not created again.
    write_whole(run_dir / REPORTS_FILE, json.dumps(content, indent=2), make_folder=False)


def add_kept_reports(run_dir: Path) -> None:
    """Add the reports that are in the spool, because no recorder took them.

    Raises:
        MachineError: they cannot be written.
    """
    content = read_object(run_dir / REPORTS_FILE)
    reports = [report for report in content.get(_EARLIER, ()) if isinstance(report, dict)]
    reports += [content[role] for role in LOOP_ROLES if isinstance(content.get(role), dict)]
    instances = {report.get("instance") for report in reports}
    new_reports = []
    for _, text in read_batches(run_dir / SPOOL, KEPT_REPORT):
        with contextlib.suppress(PeerError):  # damaged
            report = parse_message(ProcessReport, text).fields()
            if report.get("process") in LOOP_ROLES and report.get("instance") not in instances:
                new_reports.append({"generation": 0} | report)
    if new_reports:
        write_reports(run_dir, [*reports, *new_reports])


Entries = Sequence[tuple[str, Any]]
"""Roles with their reports, which may be damaged."""


def report_entries(run_dir: Path) -> Entries:
    """Return the reports in a run directory; none if a killed recorder wrote no complete file."""
    try:
        content = read_object(run_dir / REPORTS_FILE)
        entries = [(role, content[role]) for role in LOOP_ROLES if role in content]
        return entries + [(report["process"], report) for report in content.get(_EARLIER, ())]
    except (LookupError, TypeError):
        return []


def entries_of_loop(entries: Entries, number: int, rows_of_others: Callable[[int, str, int], int]) -> Entries:
    """Return the reports as of one loop: with its own rows, and its own counters of datagrams.

    ``rows_of_others(number, table, generation)`` returns how many rows of a table of the network
    are of other loops. Rows of the network that are missing in the record are missing in every loop.
    """
    reports = []
    for role, report in entries:
        with contextlib.suppress(LookupError, TypeError, ValueError, AttributeError):  # damaged
            reports.append((role, _of_loop(report, number, rows_of_others)))
    return reports


def _of_loop(report: Report, number: int, rows_of_others: Callable[[int, str, int], int]) -> Report:
    row_counts = dict(report["rows"])
    for table, by_loop in report.get("rows_by_loop", {}).items():
        row_counts[table] = by_loop[number] if number < len(by_loop) else 0
    for table in row_counts.keys() & network_tables().keys():  # there are rows of notices, too
        row_counts[table] -= rows_of_others(number, table, report.get("generation", 0))
    channel = dict(report["channel"])
    of_loops = channel.pop("loops", [])
    rejected_counts = Counter[str](channel.get("rejected"))
    channel |= of_loops[number] if number < len(of_loops) else {}
    if number == 0 and of_loops:
        for loop in of_loops:
            rejected_counts.subtract(loop.get("rejected") or {})
        if of_no_loop := +rejected_counts:  # such as datagrams of others that a socket dropped
            channel["rejected"] = channel.get("rejected", {}) | of_no_loop
    answers = channel.get("acknowledgements")
    if answers and "loops" in answers:
        channel["acknowledgements"] = answers["loops"][number]
    fields = {key: value for key, value in report.items() if key not in ("rows_by_loop", "stored")}
    return fields | {"rows": row_counts, "channel": channel}


def joint_reports(network: Mapping[str, Report], loops: Sequence[Mapping[str, Report]]) -> dict[str, Report]:
    """Return the reports of a run from those of its loops; the emulator's are of all loops."""
    reports: dict[str, Report] = {}
    if "netem" in network:
        rows = loops[0].get("netem", network["netem"])["rows"]  # also those of its clock
        reports["netem"] = network["netem"] | {"rows": rows | network["netem"]["rows"]}
    for role in [loop_role for loop_role in loops[0] if loop_role != "netem"]:
        of_loops = [loop[role] for loop in loops]
        tables = dict.fromkeys(table for report in of_loops for table in report["rows"])
        by_loop = {table: [report["rows"].get(table, 0) for report in of_loops] for table in tables}
        reports[role] = of_loops[0] | {
            "rows": {table: sum(counts) for table, counts in by_loop.items()},
            "rows_by_loop": by_loop,
            "channel": {"loops": [report["channel"] for report in of_loops]},
        }
    return reports


def valid_reports(
    entries: Entries, source: RecordSource, tables: Iterable[str]
) -> tuple[dict[str, Report], list[Report]]:
    """Return the reports of the last process of each role, and those of earlier processes.

    They have the numbers of rows of all ``tables`` that the process fills.
    """
    reports: dict[str, Report] = {}
    earlier: list[Report] = []
    for role, entry in entries:
        with contextlib.suppress(PeerError, TypeError):  # an invalid report counts as missing
            if role not in LOOP_ROLES:
                continue
            report = report_of(role, json.dumps(entry), tables)
            own_tables = [table for table in tables if OWNER[table] == role]
            if report.generation < generation_numbers(source, own_tables)[-1] or role in reports:
                earlier.append(report.fields() | {"process": role})
            else:
                reports[role] = report.fields()
    return reports, earlier


GENERATION_COLUMNS = ("input", "now_ns")


class ProcessGeneration(NamedTuple):
    """One generation of a process."""

    number: int
    rows: Mapping[str, int]
    """Number of recorded rows by table."""
    report: Report | None
    """The final report; None if it wrote none."""
    first_ns: int | None = None
    """Time of the first row; None without rows."""
    last_ns: int | None = None
    gap_ns: int | None = None
    """Time of the last input before a gap in the rows; None if there is no known gap. Rows that are
    missing at the end of a process without a report are unknown."""
    missing_inputs: int = 0
    """Number of inputs without a row, before the last recorded input."""


def generation_indices(rows: Rows, generations: Sequence[int]) -> NDArray[np.intp]:
    """Return the index of each row's generation in ``generations``, ascending, (k,).

    A row with an unexpected number belongs to the generation before.
    """
    numbers = rows["input"] // GENERATION
    return (np.searchsorted(np.array(generations), numbers, side="right") - 1).clip(min=0)


def generation_numbers(source: RecordSource, tables: Sequence[str]) -> list[int]:
    """Return the generations of a role that wrote rows, from the number of each one's first input.

    If that row is missing, the rows of a later generation prove that there were earlier ones.
    """
    if all(source.highest_input(table) < GENERATION for table in tables):
        return [0]
    first, generations = 0, np.zeros(0, np.int64)
    for table in tables:
        for rows in source.batches(table, ("input",)):
            inputs = rows["input"]
            started = inputs[(inputs % GENERATION == 0) & (inputs > 0)] // GENERATION
            first = max(first, int(started.max(initial=0)))
            generations = np.union1d(generations, inputs // GENERATION)
    return [0, *generations[(generations > 0) & (generations <= first)].tolist()]


class _Counts:
    """Counts the rows of one generation, part by part."""

    def __init__(self, generation: int, tables: Sequence[str]) -> None:
        self.rows = dict.fromkeys(tables, 0)
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.gap_ns: int | None = None
        self._input = generation * GENERATION - 1
        """The last input of the parts before."""
        self._now_ns = 0
        """Its time."""
        self._numbers: dict[int, tuple[int, int]] = {}
        """By generation in the input numbers: the largest number, and the number of rows."""

    def add(self, part: Mapping[str, Rows]) -> None:
        """Add the rows of all tables up to the same time."""
        for table, rows in part.items():
            self.rows[table] += len(rows)
        inputs = np.concatenate([rows["input"] for rows in part.values()])
        now_ns = np.concatenate([rows["now_ns"] for rows in part.values()])
        if not len(inputs):
            return
        low_ns, high_ns = int(now_ns.min()), int(now_ns.max())
        self.first_ns = low_ns if self.first_ns is None else min(self.first_ns, low_ns)
        self.last_ns = high_ns if self.last_ns is None else max(self.last_ns, high_ns)
        order = np.argsort(inputs, kind="stable")
        self._find_gap(inputs[order], now_ns[order])
        self._count_inputs(inputs[order])

    def _find_gap(self, inputs: NDArray[np.int64], now_ns: NDArray[np.int64]) -> None:
        """Find the first gap before or between inputs, which are ascending, with their times."""
        gaps = np.flatnonzero(np.diff(inputs, prepend=self._input) > 1)
        if len(gaps) and self.gap_ns is None:
            is_between_parts = gaps[0] == 0 and bool(self._numbers)
            self.gap_ns = self._now_ns if is_between_parts else int(now_ns[max(gaps[0] - 1, 0)])
        self._input, self._now_ns = int(inputs[-1]), int(now_ns[-1])

    def _count_inputs(self, inputs: NDArray[np.int64]) -> None:
        """Count inputs, which are ascending, by the generation in their numbers."""
        first, last = (int(number) // GENERATION for number in (inputs[0], inputs[-1]))
        for number in [first] if first == last else np.unique(inputs // GENERATION).tolist():
            of_generation = inputs if first == last else inputs[inputs // GENERATION == number]
            newest, count = self._numbers.get(number, (-1, 0))
            newest = max(newest, int(of_generation[-1]) % GENERATION)
            self._numbers[number] = newest, count + len(of_generation)

    @property
    def missing_inputs(self) -> int:
        return sum(newest + 1 - count for newest, count in self._numbers.values())


def read_generations(
    parts: Iterable[Slice],
    tables: Sequence[str],
    generations: Sequence[int],
    reports: Mapping[int, Report],
) -> list[ProcessGeneration]:
    """Return the generations of one process from the parts of its tables, with ``GENERATION_COLUMNS``.

    ``generations`` has their numbers, ascending; ``reports`` are by generation.
    """
    counts = [_Counts(generation, tables) for generation in generations]
    for part in parts:
        for count, rows in zip(counts, split_by_generation(part, generations), strict=True):
            count.add(rows)
    return [
        ProcessGeneration(
            generation,
            count.rows,
            reports.get(generation),
            count.first_ns,
            count.last_ns,
            count.gap_ns,
            count.missing_inputs,
        )
        for generation, count in zip(generations, counts, strict=True)
    ]


def split_by_generation(part: Slice, generations: Sequence[int]) -> Iterator[Slice]:
    """Yield the rows of each generation of a process, from rows of its tables."""
    if len(generations) == 1:
        yield part
        return
    indices = {table: generation_indices(rows, generations) for table, rows in part.items()}
    for i in range(len(generations)):
        yield {table: rows.compress(indices[table] == i) for table, rows in part.items()}

"""The processes of a run: their final reports, and which of their rows are recorded.

The reports are written as one file, and read back with care. :func:`read_rows` finds the gaps in the
rows of a process.
"""

import contextlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.rows import Rows, Slice
from cosim.record.run_directory import REPORTS_FILE, read_object
from netem.core.errors import PeerError
from netem.core.file_access import write_whole
from noack.protocol.record_tables import OWNER, network_tables
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.control_messages import ProcessReport, parse_message
from noack.runtime.spool import KEPT_REPORT, SPOOL, read_batches

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
    content = {report["process"]: report for report in reports}
    # A run directory that was deleted meanwhile is not created again.
    write_whole(run_dir / REPORTS_FILE, json.dumps(content, indent=2), make_folder=False)


def add_kept_reports(run_dir: Path) -> None:
    """Add the reports that are in the spool, because no recorder took them.

    Raises:
        MachineError: they cannot be written.
    """
    content = read_object(run_dir / REPORTS_FILE)
    reports = [content[role] for role in LOOP_ROLES if isinstance(content.get(role), dict)]
    reported = {report.get("process") for report in reports}
    new_reports = [report for report in kept_reports(run_dir) if report["process"] not in reported]
    if new_reports:
        write_reports(run_dir, [*reports, *new_reports])


def kept_reports(run_dir: Path) -> Iterator[Report]:
    """Yield the reports that processes of the loop wrote to the spool, as they could not send them."""
    for _, text in read_batches(run_dir / SPOOL, KEPT_REPORT):
        with contextlib.suppress(PeerError):  # damaged
            report = parse_message(ProcessReport, text).fields()
            if report.get("process") in LOOP_ROLES:
                yield report


Entries = Mapping[str, Any]
"""Reports by role, which may be damaged."""


def report_entries(run_dir: Path) -> Entries:
    """Return the reports in a run directory; none if a killed recorder wrote no complete file."""
    content = read_object(run_dir / REPORTS_FILE)
    return {role: content[role] for role in LOOP_ROLES if role in content}


def entries_of_loop(entries: Entries, number: int, rows_of_others: Callable[[int, str], int]) -> Entries:
    """Return the reports as of one loop: with its own rows, and its own counters of datagrams.

    ``rows_of_others(number, table)`` returns how many rows of a table of the network are of other
    loops. Rows of the network that are missing in the record are missing in every loop.
    """
    reports = {}
    for role, report in entries.items():
        with contextlib.suppress(LookupError, TypeError, ValueError, AttributeError):  # damaged
            reports[role] = _of_loop(report, number, rows_of_others)
    return reports


def _of_loop(report: Report, number: int, rows_of_others: Callable[[int, str], int]) -> Report:
    row_counts = dict(report["rows"])
    for table, by_loop in report.get("rows_by_loop", {}).items():
        row_counts[table] = by_loop[number] if number < len(by_loop) else 0
    for table in row_counts.keys() & network_tables().keys():  # there are rows of notices, too
        row_counts[table] -= rows_of_others(number, table)
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


def valid_reports(entries: Entries, tables: Iterable[str]) -> dict[str, Report]:
    """Return the reports that have the numbers of rows of all ``tables`` that the process fills."""
    reports: dict[str, Report] = {}
    for role, entry in entries.items():
        with contextlib.suppress(PeerError, TypeError):  # an invalid report counts as missing
            reports[role] = report_of(role, json.dumps(entry), tables).fields()
    return reports


ROW_COLUMNS = ("input", "now_ns")


class ProcessRows(NamedTuple):
    """The recorded rows of a process."""

    counts: Mapping[str, int]
    """Number of recorded rows by table."""
    report: Report | None
    """The final report; None if the process wrote none."""
    gap_ns: int | None = None
    """Time of the last input before a gap in the rows; None if there is no known gap. Rows that are
    missing at the end of a process without a report are unknown."""
    missing_inputs: int = 0
    """Number of inputs without a row, before the last recorded input."""


def read_rows(parts: Iterable[Slice], tables: Sequence[str], report: Report | None) -> ProcessRows:
    """Find the gaps in the rows of a process, from the parts of its tables, with ``ROW_COLUMNS``."""
    counts = dict.fromkeys(tables, 0)
    gap_ns: int | None = None
    newest, newest_ns = -1, 0  # the last input of the parts before, and its time
    highest = -1
    for part in parts:
        for table, rows in part.items():
            counts[table] += len(rows)
        inputs, now_ns = _in_order(part.values())
        if not len(inputs):
            continue
        gaps = np.flatnonzero(np.diff(inputs, prepend=newest) > 1)
        if len(gaps) and gap_ns is None:
            is_between_parts = gaps[0] == 0 and newest >= 0
            gap_ns = newest_ns if is_between_parts else int(now_ns[max(gaps[0] - 1, 0)])
        newest, newest_ns = int(inputs[-1]), int(now_ns[-1])
        highest = max(highest, newest)
    return ProcessRows(counts, report, gap_ns, highest + 1 - sum(counts.values()))


def _in_order(tables: Iterable[Rows]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return numbers and times of the inputs in all tables, by ascending numbers."""
    parts = list(tables)
    inputs = np.concatenate([rows["input"] for rows in parts])
    now_ns = np.concatenate([rows["now_ns"] for rows in parts])
    order = np.argsort(inputs, kind="stable")
    return inputs[order], now_ns[order]

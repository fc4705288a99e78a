"""The final reports of a run's processes: written as one file, read back with care."""

import contextlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.record.process_lives import generations
from cosim.record.record_source import RecordSource
from cosim.record.run_directory import REPORTS_FILE, read_object
from noack.core.errors import PeerError
from noack.core.file_access import write_whole
from noack.protocol.record_tables import OWNER
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.control_messages import ProcessReport, parse_message
from noack.runtime.spool import KEPT_REPORT, SPOOL, read_chunks

_EARLIER = "earlier"


def report_of(role: str, text: bytes | str, tables: Iterable[str]) -> dict[str, Any]:
    """Return a process's final report from its JSON.

    Raises:
        PeerError: the text is no report, or has no entry for a table of the process.
    """
    report = parse_message(ProcessReport, text)
    if not report["rows"].keys() >= {table for table in tables if OWNER[table] == role}:
        raise PeerError("the report lacks the number of rows of a table")
    return report


def write_reports(run_dir: Path, reports: Iterable[Mapping[str, Any]]) -> None:
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
    known = [one for one in content.get(_EARLIER, ()) if isinstance(one, dict)]
    known += [content[role] for role in LOOP_ROLES if isinstance(content.get(role), dict)]
    instances = {one.get("instance") for one in known}
    kept = []
    for _, text in read_chunks(run_dir / SPOOL, KEPT_REPORT):
        with contextlib.suppress(PeerError):  # damaged
            report = parse_message(ProcessReport, text)
            if report.get("process") in LOOP_ROLES and report.get("instance") not in instances:
                kept.append({"generation": 0} | report)
    if kept:
        write_reports(run_dir, [*known, *kept])


Entries = Sequence[tuple[str, Any]]
"""Roles with their reports, which may be damaged."""


def report_entries(run_dir: Path) -> Entries:
    """Return the reports in a run directory; none if a killed recorder wrote no complete file."""
    try:
        content = read_object(run_dir / REPORTS_FILE)
        entries = [(role, content[role]) for role in LOOP_ROLES if role in content]
        return entries + [(one["process"], one) for one in content.get(_EARLIER, ())]
    except (LookupError, TypeError):
        return []


def entries_of_loop(entries: Entries, number: int) -> Entries:
    """Return the reports as of one loop: with its own rows, and its own counters of datagrams."""
    found = []
    for role, report in entries:
        with contextlib.suppress(LookupError, TypeError, ValueError, AttributeError):  # damaged
            found.append((role, _of_loop(report, number)))
    return found


def _of_loop(report: dict[str, Any], number: int) -> dict[str, Any]:
    written = dict(report["rows"])
    for table, by_loop in report.get("rows_by_loop", {}).items():
        written[table] = by_loop[number] if number < len(by_loop) else 0
    channel = dict(report["channel"])
    of_loops = channel.pop("loops", [])
    rejected = Counter[str](channel.get("rejected"))
    channel |= of_loops[number] if number < len(of_loops) else {}
    if number == 0 and of_loops:
        for loop in of_loops:
            rejected.subtract(loop.get("rejected") or {})
        if of_none := +rejected:  # such as datagrams of others that a socket dropped
            channel["rejected"] = channel.get("rejected", {}) | of_none
    answers = channel.get("acknowledgements")
    if answers and "loops" in answers:
        channel["acknowledgements"] = answers["loops"][number]
    rest = {key: value for key, value in report.items() if key not in ("rows_by_loop", "stored")}
    return rest | {"rows": written, "channel": channel}


def joint_reports(
    network: Mapping[str, dict[str, Any]], loops: Sequence[Mapping[str, dict[str, Any]]]
) -> dict[str, Any]:
    """Return the reports of a run from those of its loops; the emulator's are of all loops."""
    found: dict[str, Any] = {}
    if "netem" in network:
        own = loops[0].get("netem", network["netem"])["rows"]  # also those of its clock
        found["netem"] = network["netem"] | {"rows": own | network["netem"]["rows"]}
    for role in [one for one in loops[0] if one != "netem"]:
        of_loops = [one[role] for one in loops]
        tables = dict.fromkeys(table for one in of_loops for table in one["rows"])
        by_loop = {table: [one["rows"].get(table, 0) for one in of_loops] for table in tables}
        found[role] = of_loops[0] | {
            "rows": {table: sum(counts) for table, counts in by_loop.items()},
            "rows_by_loop": by_loop,
            "channel": {"loops": [one["channel"] for one in of_loops]},
        }
    return found


def valid_reports(
    entries: Entries, source: RecordSource
) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """Return the reports of the last process of each role, and those of earlier processes."""
    reports: dict[str, dict[str, Any]] = {}
    earlier: list[dict[str, Any]] = []
    for role, entry in entries:
        with contextlib.suppress(PeerError, TypeError):  # an invalid report counts as missing
            if role not in LOOP_ROLES:
                continue
            report = report_of(role, json.dumps(entry), source.types)
            owned = [table for table in source.types if OWNER[table] == role]
            if report.get("generation", 0) < generations(source, owned)[-1] or role in reports:
                earlier.append(report | {"process": role})
            else:
                reports[role] = report
    return reports, earlier

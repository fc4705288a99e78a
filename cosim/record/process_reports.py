"""The final reports of a run's processes: written as one file, read back with care."""

import contextlib
import json
from collections.abc import Iterable, Mapping
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


def read_reports(
    run_dir: Path, source: RecordSource
) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """Return the reports of the last process of each role, and those of earlier processes."""
    try:
        content = read_object(run_dir / REPORTS_FILE)
        entries = [(role, content[role]) for role in LOOP_ROLES if role in content]
        entries += [(one["process"], one) for one in content.get(_EARLIER, ())]
    # A killed recorder wrote no report or an incomplete one.
    except (LookupError, TypeError):
        return {}, []
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

"""The record of a live run of several loops, from its spool: that of the network, and of each loop.

In the spool, each row of the plant, the sensor and the controller has the number of its loop in
front. The rows are distributed to spools of the loops, from which the record of each loop is
finished as that of a run of one loop.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from cosim.record.loop_rows import network_rows_by_loop
from cosim.record.loops_run import loop_directories
from cosim.record.process_reports import add_kept_reports
from cosim.record.record_source import Rows
from cosim.record.run_directory import (
    ENVIRONMENT_FILE,
    LOOP_FILE,
    RECORD,
    REPORTS_FILE,
    SCENARIO_FILE,
    read_object,
    write_scenario,
)
from cosim.record.run_record import RunRecord
from cosim.record.spool_conversion import finish_record, recorded_rows
from noack.config.loops import phases_ns
from noack.config.resolution import network_tables, resolved_loops, tables_of
from noack.config.scenario import Scenario
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import MachineError, PeerError, why
from noack.core.file_access import copy_whole, remove_folder, write_whole
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import LOOP, OWNER
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.control_messages import LogLine, parse_message
from noack.runtime.log_lines import batch_of, notices_of, stored_lines
from noack.runtime.spool import SPOOL, SpoolWriter, read_chunks

_PART_BYTES = 128 * 1024 * 1024
"""Rows of a table that are distributed at once."""
_WRITER = "loops"


def finish_run_record(run_dir: Path) -> RunRecord:
    """Convert the spool of a run to its record; with [[loops]], to those of the loops, too.

    An interrupted attempt can be repeated: the run's spool is removed at the end. Returns the
    record of the run, or of the network that the loops share.

    Raises:
        MachineError: a record cannot be written; the spool is kept.
    """
    for folder in distribute_rows(run_dir):
        finish_record(folder)
    return finish_record(run_dir)


def distribute_rows(
    run_dir: Path, show: Callable[[float], None] = lambda share: None
) -> Sequence[Path]:
    """Distribute the rows of a run's spool to spools of its loops; return their directories.

    Each of them then has all but the record of a run of one loop. There is none without [[loops]].
    ``show`` is called with the completed share.

    Raises:
        MachineError: they cannot be written.
    """
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    if scenario.loops is None:
        return []
    folders, phases = loop_directories(run_dir, scenario), phases_ns(scenario)
    add_kept_reports(run_dir)
    try:
        for number, loop in enumerate(resolved_loops(scenario)):
            place = {"number": number, "phase_ns": phases[number]}
            _make_directory(run_dir, folders[number], loop, place)
        _distribute(run_dir / SPOOL, scenario, folders, show)
        rows = {
            table: np.concatenate([np.zeros(0, dtype), *recorded_rows(run_dir, table, dtype)])
            for table, dtype in network_tables().items()
        }
        reports = read_object(run_dir / REPORTS_FILE)
        counts = _counts(reports, rows)
        by_loop = network_rows_by_loop(rows, phases)
        for number, (folder, own) in enumerate(zip(folders, by_loop, strict=True)):
            _spool_network(folder, own)
            content = _reports_of_loop(reports, number, counts, own)
            write_whole(folder / REPORTS_FILE, json.dumps(content, indent=2), make_folder=False)
    except OSError as error:
        raise MachineError(
            f"{run_dir}: the records of the loops cannot be written: {why(error)}; what was "
            f"recorded is kept in {run_dir / SPOOL}, and `noack summary {run_dir}` finishes it"
        ) from None
    return folders


def _make_directory(run_dir: Path, folder: Path, loop: Scenario, place: Mapping[str, int]) -> None:
    """Make the run directory of a loop; remove the spool of an interrupted attempt."""
    remove_folder(folder / SPOOL)
    if (folder / LOOP_FILE).is_file():
        return
    remove_folder(folder)
    (folder / "logs").mkdir(parents=True)
    write_scenario(loop, folder)
    copy_whole(run_dir / ENVIRONMENT_FILE, folder / ENVIRONMENT_FILE)
    write_whole(folder / LOOP_FILE, json.dumps(place, indent=2))


def _distribute(
    spool: Path, scenario: Scenario, folders: Sequence[Path], show: Callable[[float], None]
) -> None:
    """Copy the rows and log lines of a spool to the spools of the loops."""
    done_bytes, all_bytes = 0, sum(file.stat().st_size for file in spool.glob("*"))
    for table, dtype in tables_of(scenario).items():
        if OWNER[table] == "netem":
            continue
        written = np.zeros(len(folders), np.int64)
        names = [name for name in dtype.names or () if name != LOOP]
        own = np.dtype([(name, dtype[name]) for name in names])
        for rows in _parts(spool, table, dtype):
            done_bytes += rows.nbytes
            show(done_bytes / all_bytes)
            rows = rows[rows[LOOP] < len(folders)]  # the others are damaged
            rows = rows[np.argsort(rows[LOOP], kind="stable")]
            stripped = np.empty(len(rows), own)
            for name in names:
                stripped[name] = rows[name]
            ends = np.cumsum(np.bincount(rows[LOOP], minlength=len(folders))).tolist()
            for loop, (first, end) in enumerate(pairwise([0, *ends])):
                if end > first:
                    _append(folders[loop], table, int(written[loop]), stripped[first:end].tobytes())
                    written[loop] += end - first
    for role in (*LOOP_ROLES, RECORDER):
        for loop, lines in enumerate(_lines_by_loop(spool, role, len(folders))):
            if lines:
                _append(folders[loop], notices_of(role), 0, batch_of(lines))


def _lines_by_loop(spool: Path, role: str, loops: int) -> list[list[bytes]]:
    """Return the log lines of a process, by loop; those without a loop are of all loops."""
    found: list[list[bytes]] = [[] for _ in range(loops)]
    for text in stored_lines(spool, role):
        try:
            line = parse_message(LogLine, text)
            loop = line.pop(LOOP, None)
            chosen = found if loop is None else [found[loop]]
        except (PeerError, IndexError):  # damaged
            continue
        for lines in chosen:
            lines.append(json.dumps(line).encode())
    return found


def _parts(spool: Path, table: str, dtype: np.dtype[np.void]) -> Iterator[Rows]:
    """Yield the rows of a table in a spool, in large parts."""
    part: list[bytes] = []
    size_bytes = 0
    for _, data in read_chunks(spool, table):
        if len(data) % dtype.itemsize:  # damaged
            continue
        part.append(data)
        size_bytes += len(data)
        if size_bytes > _PART_BYTES:
            yield np.frombuffer(b"".join(part), dtype)
            part, size_bytes = [], 0
    if part:
        yield np.frombuffer(b"".join(part), dtype)


def _append(folder: Path, table: str, first: int, data: bytes) -> None:
    """Append a batch to the spool of a loop; its file is not kept open, as there may be many."""
    writer = SpoolWriter(folder / SPOOL, _WRITER)
    try:
        writer.append(table, first, data)
    finally:
        writer.close()


def _spool_network(folder: Path, rows: Mapping[str, Rows]) -> None:
    """Write a loop's rows of the network to its spool; they replace those of an earlier attempt."""
    for table, found in rows.items():
        (folder / RECORD / f"{table}.parquet").unlink(missing_ok=True)
        _append(folder, table, 0, found.tobytes())


_Counts = Mapping[tuple[str, int], int]
"""Number of rows by table and generation."""


def _counts(reports: Mapping[str, Any], rows: Mapping[str, Rows]) -> _Counts:
    """Return the numbers of the network's rows in the record."""
    generations = range(1 + max((_generation(one) for one in _each(reports)), default=0))
    return {(table, k): _count(found, k) for table, found in rows.items() for k in generations}


def _each(reports: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield all reports."""
    for content in reports.values():
        yield from content if isinstance(content, list) else [content]


def _generation(report: Mapping[str, Any]) -> int:
    return int(report.get("generation", 0))


def _reports_of_loop(
    reports: Mapping[str, Any], number: int, counts: _Counts, own: Mapping[str, Rows]
) -> dict[str, Any]:
    """Return the processes' final reports as of one loop.

    ``counts`` are those of the rows of the network, and ``own`` the rows of the loop. Rows of the
    network that are missing in the record are missing in every loop.
    """
    found: dict[str, Any] = {}
    for role, content in reports.items():
        every = content if isinstance(content, list) else [content]
        converted = [_report_of_loop(one, number, counts, own) for one in every]
        found[role] = converted if isinstance(content, list) else converted[0]
    return found


def _report_of_loop(
    report: dict[str, Any], number: int, counts: _Counts, own: Mapping[str, Rows]
) -> dict[str, Any]:
    written = dict(report["rows"])
    for table, by_loop in report.get("rows_by_loop", {}).items():
        written[table] = by_loop[number] if number < len(by_loop) else 0
    generation = _generation(report)
    for table in written.keys() & own.keys():
        written[table] += _count(own[table], generation) - counts[table, generation]
    channel = dict(report["channel"])
    of_loops = channel.pop("loops", [])
    channel |= of_loops[number] if number < len(of_loops) else {}
    if "acknowledgements" in channel:
        channel["acknowledgements"] = channel["acknowledgements"]["loops"][number]
    rest = {key: value for key, value in report.items() if key not in ("rows_by_loop", "stored")}
    return rest | {"rows": written, "channel": channel}


def _count(rows: Rows, generation: int) -> int:
    return int((rows["input"] // GENERATION == generation).sum())

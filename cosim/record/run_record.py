"""The numeric record of a run: spool in, Parquet out, structured arrays back.

``RUN/record/TABLE.parquet`` is the authoritative record; ``docs/record.md`` documents the columns.
Vectors are stored as one column per entry (``x_1``, ``x_2``, …), so every Parquet reader can read
them.
"""

import contextlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.record.environment import Kind, kind_of
from cosim.record.run_directory import RECORD, REPORTS_FILE, SCENARIO_FILE, read_object
from noack.config.resolution import LoopMatrices, loop_of, tables_of
from noack.config.scenario import Scenario
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import CallerError, MachineError, PeerError, one_line, why
from noack.core.file_access import write_whole
from noack.protocol.machine_interface import GENERATION, RESTART
from noack.protocol.record_tables import OWNER, entry_names
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.protocol.wire_format import VERSION, Flow, read_header
from noack.runtime.control_messages import LogLine, ProcessReport, parse_message
from noack.runtime.spool import SPOOL, read_chunks
from noack.runtime.telemetry import notices_of

Rows = NDArray[np.void]

_NOTICES_FILE = "notices.jsonl"
_EARLIER = "earlier"


class _Notice(LogLine):
    process: str


class RunRecord:
    """The record of one run.

    Args:
        scenario: the resolved scenario.
        rows: the rows of each table, in the order of the machine's inputs.
        notices: the lines of the run's log, each with t_ns, level, text and process.
        reports: each process's final report; a process that died has none.
        kind: live or simulated.
        earlier: the final reports of processes that were restarted later.
    """

    def __init__(
        self,
        scenario: Scenario,
        rows: Mapping[str, Rows],
        notices: list[dict[str, Any]],
        reports: Mapping[str, dict[str, Any]],
        kind: Kind = "live",
        earlier: Sequence[dict[str, Any]] = (),
    ) -> None:
        self.scenario = scenario
        self.loop: LoopMatrices = loop_of(scenario)
        self.notices = notices
        self.reports = reports
        self.earlier = earlier
        self.kind: Kind = kind
        self._rows = rows
        self.tables = tables_of(scenario)

    def __getitem__(self, table: str) -> Rows:
        """Rows of a table of ``noack.protocol.record_tables``."""
        return self._rows[table]

    def owned_by(self, role: str) -> dict[str, Rows]:
        """Return the tables that a process writes."""
        return {table: self[table] for table in self.tables if OWNER[table] == role}

    def lives(self, role: str) -> list["Life"]:
        """The rows and reports of each generation of a process, in order."""
        owned, newest = self.owned_by(role), self.reports.get(role)
        reports = {} if newest is None else {newest.get("generation", 0): newest}
        reports |= {one.get("generation", 0): one for one in self.earlier if one["process"] == role}
        again = any((one["process"], one["level"]) == (role, RESTART) for one in self.notices)
        begun = generations(owned) if again else [0]
        which = {  # a row with an unexpected number belongs to the generation before
            table: np.searchsorted(begun, rows["input"] // GENERATION, side="right") - 1
            for table, rows in owned.items()
        }
        return [
            Life(
                number,
                {table: rows[which[table].clip(min=0) == i] for table, rows in owned.items()},
                reports.get(number),
            )
            for i, number in enumerate(begun)
        ]

    def restarted(self) -> str | None:
        """A role whose process was restarted; None if there is none."""
        return next((role for role in LOOP_ROLES if len(self.lives(role)) > 1), None)


class Life(NamedTuple):
    """The rows and the report of one generation of a process."""

    generation: int
    rows: Mapping[str, Rows]
    """By table."""
    report: Mapping[str, Any] | None

    def hole_ns(self) -> int | None:
        """Time of the last input before a gap in the rows; None if there is no known gap.

        Rows that are missing at the end of a process without a report are unknown.
        """
        inputs = np.concatenate([rows["input"] for rows in self.rows.values()])
        now_ns = np.concatenate([rows["now_ns"] for rows in self.rows.values()])
        order = np.argsort(inputs, kind="stable")
        inputs, now_ns = inputs[order], now_ns[order]
        holes = np.flatnonzero(np.diff(inputs, prepend=self.generation * GENERATION - 1) > 1)
        return None if not len(holes) else int(now_ns[max(holes[0] - 1, 0)])


def generations(owned: Mapping[str, Rows]) -> list[int]:
    """Return the generations of a role that wrote rows, from the number of each one's first input.

    If that row is missing, the rows of a later generation prove that there were earlier ones.
    """
    inputs = np.concatenate([rows["input"] for rows in owned.values()])
    first = inputs[(inputs % GENERATION == 0) & (inputs > 0)] // GENERATION
    of = np.unique(inputs // GENERATION)
    return [0, *of[(of > 0) & (of <= first.max(initial=0))].tolist()]


def load_record(run_dir: Path) -> RunRecord:
    """Read the record of a run directory.

    Raises:
        CallerError: the path is no run directory, or the record is unfinished or damaged.
    """
    folder = run_dir / RECORD
    if not (run_dir / SCENARIO_FILE).is_file():
        raise CallerError(f"{run_dir}: not a run directory (no {SCENARIO_FILE})")
    if not folder.is_dir():
        raise CallerError(
            f"{run_dir}: has no numeric record; `noack summary` finalises an interrupted run"
        )
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    rows = {
        table: _from_parquet(folder / f"{table}.parquet", dtype)
        for table, dtype in tables_of(scenario).items()
    }
    reports, earlier = _reports(run_dir, rows)
    return RunRecord(scenario, rows, _read_notices(folder), reports, kind_of(run_dir), earlier)


def write_record(record: RunRecord, run_dir: Path) -> None:
    """Write a record's tables and notices into its run directory.

    Raises:
        OSError: they cannot be written.
    """
    folder, loop = run_dir / RECORD, record.loop
    folder.mkdir(exist_ok=True)
    for table in record.tables:
        _to_parquet(record[table], folder / f"{table}.parquet", loop)
    with (folder / _NOTICES_FILE).open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(notice) + "\n" for notice in record.notices)


def finish_record(run_dir: Path) -> RunRecord:
    """Convert a run's spool to its record, and remove the spool.

    It merges all spools and removes duplicate rows.

    Raises:
        MachineError: the record cannot be written; the spool is kept.
    """
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    spool, folder = run_dir / SPOOL, run_dir / RECORD
    rows = {
        table: merge_rows([_recorded(folder, table, dtype), *_spooled(spool, table, dtype)], dtype)
        for table, dtype in tables_of(scenario).items()
    }
    notices, (reports, earlier) = _notices(folder, spool), _reports(run_dir, rows)
    record = RunRecord(scenario, rows, notices, reports, kind_of(run_dir), earlier)
    try:
        write_record(record, run_dir)
        if spool.is_dir():  # moved in one step, so that an incomplete spool is never read
            shutil.rmtree(spool.rename(spool.with_name(f"{SPOOL}.done")), ignore_errors=True)
    except OSError as error:
        raise MachineError(
            f"{folder}: the record cannot be written: {why(error)}; what was recorded is kept "
            f"in {spool}, and `noack summary {run_dir}` finishes it"
        ) from None
    return record


def merge_rows(parts: Sequence[Rows], dtype: np.dtype[np.void]) -> Rows:
    """Return the rows of a table in the order of the machine's inputs, without duplicates."""
    rows = np.concatenate([np.zeros(0, dtype), *parts])
    _, first = np.unique(rows["input"], return_index=True)
    return rows[first]


def updates_in(
    packets: Rows, flow: Flow = Flow.UPDATE
) -> tuple[Rows, NDArray[np.int64], NDArray[np.int64]]:
    """Select the loop's updates from the packets that reached the network emulator.

    The emulator reads no payload, so the packets' headers are read here.

    Returns:
        Their rows of ``netem_packet``, sequence numbers and event times.
    """
    indices, sequences, events_ns = [], [], []
    for i, head in enumerate(packets["head"]):
        header = read_header(head.tobytes())
        if header is None or (header.version, header.flow) != (VERSION, flow):
            continue
        if header.sequence < 2**63 and header.t_ns >= 0:  # others do not fit the record's columns
            indices.append(i)
            sequences.append(header.sequence)
            events_ns.append(header.t_ns)
    return (
        packets[indices],
        np.array(sequences, dtype=np.int64),
        np.array(events_ns, dtype=np.int64),
    )


def _recorded(folder: Path, table: str, dtype: np.dtype[np.void]) -> Rows:
    path = folder / f"{table}.parquet"
    return _from_parquet(path, dtype) if path.is_file() else np.zeros(0, dtype)


def _spooled(spool: Path, table: str, dtype: np.dtype[np.void]) -> Iterator[Rows]:
    for _, data in read_chunks(spool, table):
        if len(data) % dtype.itemsize == 0:  # the rows of a damaged chunk cannot be located
            yield np.frombuffer(data, dtype)


def _notices(folder: Path, spool: Path) -> list[dict[str, Any]]:
    notices = _read_notices(folder)
    for role in (*LOOP_ROLES, RECORDER):
        for _, data in read_chunks(spool, notices_of(role)):
            try:
                notice = parse_message(LogLine, data) | {"process": role}
            except PeerError:  # damaged
                continue
            if notice not in notices:
                notices.append(notice)
    return sorted(notices, key=lambda notice: int(notice["t_ns"]))


def _read_notices(folder: Path) -> list[dict[str, Any]]:
    path = folder / _NOTICES_FILE
    try:
        lines = path.read_bytes().splitlines() if path.is_file() else []
        return [parse_message(_Notice, line) for line in lines]
    except (OSError, PeerError) as error:
        raise CallerError(f"{path}: cannot be read: {error}") from None


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


def _reports(
    run_dir: Path, rows: Mapping[str, Rows]
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
            report = report_of(role, json.dumps(entry), rows)
            owned = {table: rows[table] for table in rows if OWNER[table] == role}
            if report.get("generation", 0) < generations(owned)[-1] or role in reports:
                earlier.append(report | {"process": role})
            else:
                reports[role] = report
    return reports, earlier


def _to_parquet(rows: Rows, path: Path, loop: LoopMatrices) -> None:
    columns: dict[str, Any] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.ndim == 2:
            for entry, values in zip(entry_names(name, column.shape[1]), column.T, strict=True):
                columns[entry] = pa.array(np.ascontiguousarray(values))
        elif column.dtype.kind == "V":
            width = column.dtype.itemsize
            raw = pa.py_buffer(np.ascontiguousarray(column).tobytes())
            columns[name] = pa.Array.from_buffers(pa.binary(width), len(rows), [None, raw])
        else:
            columns[name] = pa.array(np.ascontiguousarray(column))
    metadata = {
        "noack_table": path.stem,
        "process": OWNER[path.stem],
        "state_names": json.dumps(loop.state_names),
        "input_names": json.dumps(loop.input_names),
    }
    table = pa.table(columns).replace_schema_metadata(metadata)
    scratch = path.with_suffix(".partial")
    pq.write_table(table, scratch, compression="zstd")
    scratch.replace(path)


def _columns(dtype: np.dtype[np.void]) -> Iterator[tuple[str, pa.DataType]]:
    """Yield the names of a table's columns in its file, and their types."""
    for name in dtype.names or ():
        field = dtype[name]
        if field.shape:
            kind = pa.from_numpy_dtype(field.base)
            yield from ((entry, kind) for entry in entry_names(name, field.shape[0]))
        elif field.kind == "V":
            yield name, pa.binary(field.itemsize)
        else:
            yield name, pa.from_numpy_dtype(field)


def read_table(path: Path, dtype: np.dtype[np.void]) -> pa.Table:
    """Read a table's file as it is.

    Raises:
        CallerError: the file cannot be read, or does not have all columns of that type.
    """
    try:
        table = pq.read_table(path)
        table.validate(full=True)
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise CallerError(f"{path}: cannot be read: {one_line(error)}") from None
    for column, kind in _columns(dtype):
        found = table.schema.get_all_field_indices(column)
        if not found:
            raise CallerError(f"{path}: has no column {column}, which this scenario's runs have")
        if len(found) > 1 or table.schema.field(found[0]).type != kind:
            raise CallerError(f"{path}: column {column} is not one of {kind}")
        if table.column(found[0]).null_count:
            raise CallerError(f"{path}: column {column} has holes")
    return table


def _from_parquet(path: Path, dtype: np.dtype[np.void]) -> Rows:
    table = read_table(path, dtype)
    rows = np.zeros(table.num_rows, dtype)
    for name in dtype.names or ():
        field = dtype[name]
        if field.shape:
            for i, entry in enumerate(entry_names(name, field.shape[0])):
                rows[name][:, i] = table[entry].to_numpy()
        elif field.kind == "V":
            raw = b"".join(value or b"" for value in table[name].to_pylist())
            rows[name] = np.frombuffer(raw, field)
        else:
            rows[name] = table[name].to_numpy()
    return rows

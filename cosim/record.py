"""The numeric record of a run: spool in, Parquet out, structured arrays back.

``RUN/record/TABLE.parquet`` is the run's truth; ``docs/record.md`` documents the columns. Vectors
are stored one column per entry (``x_0``, ``x_1``, …) so that any reader of Parquet takes them.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.run_dir import RECORD, REPORTS_FILE, SCENARIO_FILE, SPOOL
from noack.errors import CallerError, MachineError
from noack.io.spool import read_chunks
from noack.io.telemetry import notices_of
from noack.records import OWNER, tables
from noack.resolve import Loop, loop_of
from noack.scenario import Scenario
from noack.scenario_file import load
from noack.topology import LOOP_ROLES

Rows = NDArray[np.void]

_NOTICES_FILE = "notices.jsonl"


class RunRecord:
    """The record of one run.

    Args:
        scenario: the resolved scenario.
        rows: the rows of each table, in the order of the machine's inputs.
        notices: the lines of the run's log, each with t_ns, level, text and process.
        reports: each process's final report; a process that died has none.
    """

    def __init__(
        self,
        scenario: Scenario,
        rows: Mapping[str, Rows],
        notices: list[dict[str, Any]],
        reports: Mapping[str, dict[str, Any]],
    ) -> None:
        self.scenario = scenario
        self.loop: Loop = loop_of(scenario)
        self.notices = notices
        self.reports = reports
        self._rows = rows

    def __getitem__(self, table: str) -> Rows:
        """Rows of a table of ``noack.records``."""
        return self._rows[table]


def load_record(run_dir: Path) -> RunRecord:
    """Read the record of a run directory.

    Raises:
        CallerError: it is not a run directory, or the run's record was never finished.
    """
    folder = run_dir / RECORD
    if not (run_dir / SCENARIO_FILE).is_file():
        raise CallerError(f"{run_dir}: not a run directory (no {SCENARIO_FILE})")
    if not folder.is_dir():
        raise CallerError(f"{run_dir}: has no numeric record")
    scenario = load(run_dir / SCENARIO_FILE)
    loop = loop_of(scenario)
    rows = {
        table: _from_parquet(folder / f"{table}.parquet", dtype)
        for table, dtype in tables(loop.n, loop.m).items()
    }
    lines = (folder / _NOTICES_FILE).read_text().splitlines()
    return RunRecord(scenario, rows, [json.loads(line) for line in lines], _reports(run_dir))


def finish_record(run_dir: Path) -> RunRecord:
    """Turn a run's spool into its record, and remove the spool.

    Works on whatever was spooled, by whomever, and merges what was spooled twice.

    Raises:
        MachineError: the record cannot be written; the spool is kept.
    """
    scenario = load(run_dir / SCENARIO_FILE)
    loop, spool, folder = loop_of(scenario), run_dir / SPOOL, run_dir / RECORD
    rows = {
        table: merge_rows(
            [(first, np.frombuffer(data, dtype)) for first, data in read_chunks(spool, table)],
            dtype,
        )[1]
        for table, dtype in tables(loop.n, loop.m).items()
    }
    notices = _spooled_notices(spool)
    try:
        folder.mkdir(exist_ok=True)
        for table, array in rows.items():
            _to_parquet(array, folder / f"{table}.parquet", loop)
        with (folder / _NOTICES_FILE).open("w") as file:
            file.writelines(json.dumps(notice) + "\n" for notice in notices)
    except OSError as error:
        raise MachineError(
            f"{folder}: the record cannot be written ({error}); it is kept in {spool}"
        ) from None
    for path in spool.glob("*"):
        path.unlink()
    if spool.is_dir():
        spool.rmdir()
    return RunRecord(scenario, rows, notices, _reports(run_dir))


def merge_rows(
    batches: list[tuple[int, Rows]], dtype: np.dtype[np.void]
) -> tuple[list[tuple[int, int]], Rows]:
    """Put batches in order of their row numbers, dropping what came twice.

    Returns:
        The half-open ranges of row numbers that are missing before the last row, and the rows.
    """
    missing: list[tuple[int, int]] = []
    parts: list[Rows] = []
    following = 0
    for first, rows in sorted(batches, key=lambda batch: batch[0]):
        if first > following:
            missing.append((following, first))
            following = first
        fresh = rows[following - first :]
        parts.append(fresh)
        following += len(fresh)
    return missing, np.concatenate(parts) if parts else np.zeros(0, dtype)


def _spooled_notices(spool: Path) -> list[dict[str, Any]]:
    notices: dict[tuple[str, int], dict[str, Any]] = {}
    for role in LOOP_ROLES:
        for first, data in read_chunks(spool, notices_of(role)):
            notices[role, first] = json.loads(data) | {"process": role}
    return sorted(notices.values(), key=lambda notice: int(notice["t_ns"]))


def _reports(run_dir: Path) -> dict[str, dict[str, Any]]:
    path = run_dir / REPORTS_FILE
    reports: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.is_file() else {}
    return reports


def _to_parquet(rows: Rows, path: Path, loop: Loop) -> None:
    columns: dict[str, Any] = {}
    for name in rows.dtype.names or ():
        column = rows[name]
        if column.ndim == 2:
            for i in range(column.shape[1]):
                columns[f"{name}_{i}"] = pa.array(np.ascontiguousarray(column[:, i]))
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


def _from_parquet(path: Path, dtype: np.dtype[np.void]) -> Rows:
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise CallerError(f"{path}: cannot be read: {error}") from None
    rows = np.zeros(table.num_rows, dtype)
    for name in dtype.names or ():
        field = dtype[name]
        if field.shape:
            for i in range(field.shape[0]):
                rows[name][:, i] = table[f"{name}_{i}"].to_numpy()
        elif field.kind == "V":
            raw = b"".join(value or b"" for value in table[name].to_pylist())
            rows[name] = np.frombuffer(raw, field)
        else:
            rows[name] = table[name].to_numpy()
    return rows

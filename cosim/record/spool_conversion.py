"""Converts the spool of a run to its record: all spools merged, without duplicate rows."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cosim.record.process_reports import add_kept_reports
from cosim.record.record_source import Rows
from cosim.record.run_directory import RECORD, SCENARIO_FILE
from cosim.record.run_record import RunRecord, load_record, read_notices, write_tables
from cosim.record.spool_merge import merged, spool_segments
from noack.config.resolution import loop_of, network_tables, tables_of
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import MachineError, PeerError, why
from noack.core.file_access import remove_folder
from noack.protocol.record_tables import LOOP
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.control_messages import LogLine, parse_message
from noack.runtime.log_lines import stored_lines
from noack.runtime.spool import SPOOL


def finish_record(run_dir: Path) -> RunRecord:
    """Convert a run's spool to its record, and remove the spool; see :func:`convert_spool`."""
    add_kept_reports(run_dir)
    convert_spool(run_dir)
    remove_spool(run_dir)
    return load_record(run_dir, network=True)


def convert_spool(run_dir: Path) -> None:
    """Convert a run's spool to its record.

    It merges all spools and removes duplicate rows. Of a run with [[loops]], it converts the part
    of the network; see :func:`cosim.record.loops_spool.finish_run_record`.

    Raises:
        MachineError: the record cannot be written; the spool is kept.
    """
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    is_network = scenario.loops is not None
    types = network_tables() if is_network else tables_of(scenario)
    spool, folder = run_dir / SPOOL, run_dir / RECORD
    tables = {table: recorded_rows(run_dir, table, dtype) for table, dtype in types.items()}
    notices = [one for one in _notices(folder, spool) if one.get(LOOP) is None]
    try:
        write_tables(folder, tables, types, None if is_network else loop_of(scenario), notices)
    except OSError as error:
        raise _kept(run_dir, error) from None


def remove_spool(run_dir: Path) -> None:
    """Remove a run's spool, whose rows are in its record.

    Raises:
        MachineError: it cannot be removed.
    """
    spool = run_dir / SPOOL
    try:
        if spool.is_dir():  # moved in one step, so that an incomplete spool is never read
            done = spool.with_name(f"{SPOOL}.done")
            remove_folder(done)  # of an earlier attempt that was interrupted
            remove_folder(spool.rename(done))
    except OSError as error:
        raise _kept(run_dir, error) from None


def _kept(run_dir: Path, error: OSError) -> MachineError:
    return MachineError(
        f"{run_dir / RECORD}: the record cannot be written: {why(error)}; what was recorded is "
        f"kept in {run_dir / SPOOL}, and `noack summary {run_dir}` finishes it"
    )


def recorded_rows(run_dir: Path, table: str, dtype: np.dtype[np.void]) -> Iterator[Rows]:
    """Yield the rows of a table from an earlier record and from the spool."""
    from cosim.record.table_files import group_segments

    path = run_dir / RECORD / f"{table}.parquet"
    recorded = group_segments(path, dtype) if path.is_file() else ()
    yield from merged([*recorded, *spool_segments(run_dir / SPOOL, table, dtype)], dtype)


def _notices(folder: Path, spool: Path) -> list[dict[str, Any]]:
    notices = read_notices(folder)
    known = {json.dumps(notice, sort_keys=True) for notice in notices}
    for role in (*LOOP_ROLES, RECORDER):
        for line in stored_lines(spool, role):
            try:
                notice = parse_message(LogLine, line) | {"process": role}
            except PeerError:  # damaged
                continue
            if (text := json.dumps(notice, sort_keys=True)) not in known:
                known.add(text)
                notices.append(notice)
    return sorted(notices, key=lambda notice: int(notice["t_ns"]))

"""Converts the spool of a run to its record: all spools merged, without duplicate rows."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cosim.record.process_reports import add_kept_reports
from cosim.record.record_source import Rows
from cosim.record.run_directory import RECORD, SCENARIO_FILE
from cosim.record.run_record import (
    RecordedRun,
    load_run,
    read_notices,
    vector_names,
    write_tables,
)
from cosim.record.spool_merge import by_loop, merged, spool_segments
from noack.config.resolution import has_loop, run_tables
from noack.config.scenario import loop_names
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import MachineError, PeerError, why
from noack.core.file_access import remove_folder
from noack.protocol.record_tables import LOOP
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.control_messages import LogLine, parse_message
from noack.runtime.log_lines import stored_lines
from noack.runtime.spool import SPOOL, spool_files

_BLOCK_BYTES = 64 * 1024 * 1024
"""Rows of several loops that are sorted at once."""


def finish_record(run_dir: Path, show: Callable[[float], None] = lambda share: None) -> RecordedRun:
    """Convert a run's spool to its record, and remove the spool.

    All spools are merged, without duplicate rows. An interrupted attempt can be repeated. ``show``
    is called with the completed share.

    Raises:
        MachineError: the record cannot be written; the spool is kept.
    """
    add_kept_reports(run_dir)
    _convert(run_dir, show)
    remove_spool(run_dir)
    return load_run(run_dir)


def _convert(run_dir: Path, show: Callable[[float], None]) -> None:
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    types, loops = run_tables(scenario), len(loop_names(scenario))

    def tables() -> Iterator[tuple[str, Iterator[Rows]]]:
        for place, (table, dtype) in enumerate(types.items()):
            show(place / len(types))
            yield table, _by_loop(run_dir, table, dtype, loops)

    notices = _notices(run_dir / RECORD, run_dir / SPOOL, loops)
    try:
        write_tables(run_dir / RECORD, tables(), types, vector_names(scenario), notices)
    except OSError as error:
        raise _kept(run_dir, error) from None


def _by_loop(run_dir: Path, table: str, dtype: np.dtype[np.void], loops: int) -> Iterator[Rows]:
    """Yield the rows of a table from an earlier record and from the spool, loop after loop.

    Of many loops, as many are sorted at once as fit into memory; one loop is never in memory as a
    whole.
    """
    from cosim.record.table_files import group_segments  # imports pyarrow

    path = run_dir / RECORD / f"{table}.parquet"
    segments = [*group_segments(path, dtype)] if path.is_file() else []
    segments += spool_segments(run_dir / SPOOL, table, dtype)
    if loops == 1 or not has_loop(table):
        yield from merged(segments, dtype)
        return
    paths = [*spool_files(run_dir / SPOOL, table), *([path] if path.is_file() else [])]
    all_bytes = sum(one.stat().st_size for one in paths)
    at_once = max(loops * _BLOCK_BYTES // max(all_bytes, _BLOCK_BYTES), 1)
    for first in range(0, loops, at_once):
        yield from by_loop(segments, dtype, range(first, min(first + at_once, loops)))


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


def _notices(folder: Path, spool: Path, loops: int) -> list[dict[str, Any]]:
    notices = read_notices(folder)
    known = {json.dumps(notice, sort_keys=True) for notice in notices}
    for role in (*LOOP_ROLES, RECORDER):
        for line in stored_lines(spool, role):
            try:
                notice = parse_message(LogLine, line) | {"process": role}
            except PeerError:  # damaged
                continue
            if notice.get(LOOP, 0) not in range(loops):  # damaged
                continue
            if (text := json.dumps(notice, sort_keys=True)) not in known:
                known.add(text)
                notices.append(notice)
    return sorted(notices, key=lambda notice: int(notice["t_ns"]))

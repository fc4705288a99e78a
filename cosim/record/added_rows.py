"""Adds to the record of a run what a process on another host kept, because it could not send it.

A host may be hostile: only rows are taken of a process that knows its secret, so that one host cannot
write rows of another one's. They are merged in a copy of the run directory, which replaces it if each
recorded row is in it unchanged, and no table has more rows than its process reported.
"""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np

from cosim.record.rows import Rows
from cosim.record.run_directory import ENVIRONMENT_FILE, PROCESSES_FILE, finished_run, read_object
from cosim.record.run_record import RunRecord, load_run, resolved_run
from netem.core.errors import CallerError, MachineError, NoackError, PeerError, why
from netem.core.file_access import move, open_folder
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.control_messages import ProcessReport, parse_message
from noack.runtime.spool import KEPT_REPORT, SPOOL, SpoolWriter, notices_of, writer_of
from noack.runtime.unsent_rows_file import KeptHead, KeptPart, read_kept

T = TypeVar("T")


def add_rows(run_dir: Path, file: Path, complete: Callable[[Path], T]) -> tuple[T, str]:
    """Add the rows in a file to the record of a run.

    A file may be added again: rows that are there twice count once. Until the new record is complete,
    nothing in the run directory changes.

    Args:
        run_dir: the run directory, with a complete record.
        file: what a process of the run kept.
        complete: completes the record and summary of a run directory.

    Returns:
        The result of ``complete``, and the process.

    Raises:
        CallerError: the file is of another run or cannot be read, or the run is under way.
        PeerError: the file cannot be of a process of this run.
        MachineError: the record cannot be written.
    """
    try:
        with open_folder(run_dir):  # no link of another user is on the way
            run_dir = run_dir.resolve()
        with (
            finished_run(run_dir),
            tempfile.TemporaryDirectory(dir=run_dir.parent, prefix=f".{run_dir.name}.") as scratch,
        ):
            head, parts = read_kept(file)
            _require_process(run_dir, head, file)
            merged = Path(scratch) / run_dir.name
            shutil.copytree(run_dir, merged, symlinks=True)
            _take(merged, head, parts, file)
            outcome = _complete(complete, merged, run_dir, file)
            _require_consistent(run_dir, merged, file)
            move(run_dir, Path(scratch) / "before")
            move(merged, run_dir)
    except OSError as error:
        # Of several files that cannot be copied, each with source and copy: the first one's reason.
        reason = error.args[0][0][2] if isinstance(error, shutil.Error) else why(error)
        raise MachineError(f"{run_dir}: nothing was added from {file}: {reason}") from None
    return outcome, head.process


def _require_process(run_dir: Path, head: KeptHead, file: Path) -> None:
    """Raise unless a file's process joined a run, as the one that knows this secret."""
    if head.run != read_object(run_dir / ENVIRONMENT_FILE).get("run_name"):
        raise CallerError(f"{file}: it belongs to another run than {run_dir}")
    role = read_object(run_dir / PROCESSES_FILE).get(writer_of(head.secret))
    if head.process not in LOOP_ROLES or role != head.process:
        raise PeerError(f"{file}: it is not of the {head.process} of this run")


def _take(run_dir: Path, head: KeptHead, parts: Iterator[tuple[KeptPart, bytes]], file: Path) -> None:
    """Copy what a process kept into the spool of a run; raise PeerError if the process has no such rows."""
    types = resolved_run(run_dir).tables
    own = {table for table in types if OWNER[table] == head.process}
    spool = SpoolWriter(run_dir / SPOOL, writer_of(head.secret))
    try:
        for part, content in parts:
            if part.table == KEPT_REPORT:
                _require_own_report(head, content, file)
            elif part.table not in (*own, notices_of(head.process)):
                raise PeerError(f"{file}: the {head.process} has no table {part.table!r}")
            elif part.table in own and len(content) % types[part.table].itemsize:
                raise PeerError(f"{file}: damaged: part of a row of {part.table}")
            spool.append(part.table, part.first, content)
    finally:
        spool.close()


def _require_own_report(head: KeptHead, content: bytes, file: Path) -> None:
    try:
        report = parse_message(ProcessReport, content).fields()
    except PeerError as error:
        raise PeerError(f"{file}: {error}") from None
    if (report.get("process"), report.get("instance")) != (head.process, writer_of(head.secret)):
        raise PeerError(f"{file}: it has the report of another process")


def _complete(complete: Callable[[Path], T], merged: Path, run_dir: Path, file: Path) -> T:
    """Complete the merged record; an error names the run, and not the copy that is removed."""
    try:
        return complete(merged)
    except MachineError as error:
        reason = str(error).partition(";")[0].replace(str(merged), str(run_dir))
        raise MachineError(f"{reason}; nothing was added from {file}") from None
    except Exception as error:  # rows that no process writes
        text = str(error) if isinstance(error, NoackError) else repr(error)
        raise PeerError(f"{file}: its rows cannot be merged: {text}") from None


def _require_consistent(before_dir: Path, after_dir: Path, file: Path) -> None:
    """Raise PeerError unless each row of a record is in a later one, and no row was made up."""
    for before, after in zip(_records(before_dir), _records(after_dir), strict=True):
        for table in before.tables:
            if not _contains(before, after, table):
                raise PeerError(f"{file}: it has other rows of {table} than were recorded")
        for role in LOOP_ROLES:
            reported_rows = after.reports[role]["rows"] if role in after.reports else {}
            counts = after.row_counts(role)
            for table in reported_rows.keys() & counts.keys():
                if (surplus := counts[table] - reported_rows[table]) > 0:
                    raise PeerError(
                        f"{file}: with its rows, {table} has {surplus} more than the {role} reported"
                    )


def _records(run_dir: Path) -> Iterator[RunRecord]:
    """Yield the records of a run: of the network, and of each loop."""
    run = load_run(run_dir)
    yield run.network
    yield from run.loops


def _contains(before: RunRecord, after: RunRecord, table: str) -> bool:
    """Whether each row of a table is, with the same bits, in the table of a later record."""
    batches = after.batches(table)
    rows: Rows = np.zeros(0, after.tables[table])
    for old in before.batches(table):
        while not len(rows) or rows["input"][-1] < old["input"][-1]:
            if (batch := next(batches, None)) is None:
                return False
            rows = np.concatenate([rows, batch])
        indices = np.searchsorted(rows["input"], old["input"])
        if rows[indices].tobytes() != old.tobytes():
            return False
        rows = rows[indices[-1] :]
    return True

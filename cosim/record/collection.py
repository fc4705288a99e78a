"""Collects what processes on other hosts kept of a run, because they could not send it.

Each process writes files of its own, named after it. A host may be hostile: only rows are taken of
processes whose secret is in the folder, so that one host cannot write rows of another one's. They
are merged in a copy of the run directory, which replaces it when no recorded row has changed.
"""

import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from cosim.record.record_source import Rows
from cosim.record.run_directory import (
    ENVIRONMENT_FILE,
    PROCESSES_FILE,
    SCENARIO_FILE,
    finished_run,
    read_object,
)
from cosim.record.run_record import RunRecord, load_run
from noack.core.errors import CallerError, MachineError, NoackError, PeerError, why
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.control_messages import ProcessReport, parse_message
from noack.runtime.spool import (
    KEPT_KEY,
    KEPT_REPORT,
    SPOOL,
    SpoolBatch,
    SpoolWriter,
    batches_of_file,
    kept_run_name,
    notices_of,
    writer_of,
)
from noack.scenario.resolution import run_tables
from noack.scenario.scenario_file import MOST_RECORDED_BYTES, load

_MOST_BATCH_BYTES = 64 * 2**20
"""A process keeps no more in memory before it writes a batch."""

T = TypeVar("T")


class _Process(NamedTuple):
    """A process that joined the run."""

    role: str
    writer: str


def collect(run_dir: Path, source: str, complete: Callable[[Path], T]) -> tuple[T, list[str]]:
    """Add what was kept in ``FOLDER``, or in ``HOST:FOLDER``, to the record of a run.

    Files that were added before may be added again: rows that are there twice count once. Until the
    new record is complete and has all rows of the old one, nothing in the run directory changes.

    Args:
        run_dir: the run directory, with a complete record.
        source: the folder.
        complete: completes the record and summary of a run directory.

    Returns:
        The result of ``complete``, and the roles whose rows were taken.

    Raises:
        CallerError: nothing of this run is there, or the run is under way.
        PeerError: the host cannot be reached, or what it kept cannot be of its processes.
        MachineError: a file cannot be copied.
    """
    run_dir = run_dir.resolve()
    try:
        with (
            finished_run(run_dir),
            _reachable(source) as folder,
            tempfile.TemporaryDirectory(dir=run_dir.parent, prefix=f".{run_dir.name}.") as scratch,
        ):
            _require_kept_of(run_dir, folder, source)
            merged = Path(scratch) / run_dir.name
            shutil.copytree(run_dir, merged, symlinks=True)
            roles = _take(folder / SPOOL, merged, source)
            outcome = _complete(complete, merged, run_dir, source)
            _require_consistent(run_dir, merged, source)
            run_dir.rename(Path(scratch) / "before")
            merged.rename(run_dir)
    except OSError as error:
        # Of several files that cannot be copied, each with source and copy: the first one's reason.
        reason = error.args[0][0][2] if isinstance(error, shutil.Error) else why(error)
        raise MachineError(f"{run_dir}: nothing was added from {source}: {reason}") from None
    return outcome, roles


def _complete(complete: Callable[[Path], T], merged: Path, run_dir: Path, source: str) -> T:
    """Complete the merged record; an error names the run, and not the copy that is removed."""
    try:
        return complete(merged)
    except MachineError as error:
        reason = str(error).partition(";")[0].replace(str(merged), str(run_dir))
        raise MachineError(f"{reason}; nothing was added from {source}") from None
    except Exception as error:  # rows that no process writes
        text = str(error) if isinstance(error, NoackError) else repr(error)
        raise PeerError(f"{source}: what was kept there cannot be merged: {text}") from None


def _require_kept_of(run_dir: Path, folder: Path, source: str) -> None:
    if not any((folder / SPOOL).glob("*.*")):
        raise CallerError(f"{source}: nothing was kept there (no files in {SPOOL}/)")
    if kept_run_name(folder) != read_object(run_dir / ENVIRONMENT_FILE).get("run_name"):
        raise CallerError(f"{source}: it belongs to another run than {run_dir}")


def _take(folder: Path, run_dir: Path, source: str) -> list[str]:
    """Copy what processes kept into the spool of a run; return their roles.

    Raises:
        PeerError: a file is not of a process that kept its secret there.
    """
    processes = {process.writer: process for process in _joined_processes(run_dir)}
    types = run_tables(load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES))
    roles = set()
    for path in sorted(folder.glob("*.*")):
        table, _, writer = path.name.partition(".")
        process, name = processes.get(writer), f"{source}: {SPOOL}/{path.name}"
        if process is None:
            raise PeerError(f"{name} belongs to no process that joined this run")
        if not _has_secret(folder, process, source):
            raise PeerError(f"{source}: the {process.role} of this run did not run there")
        if table == KEPT_KEY:
            continue
        _require_own(table, process, types, name)
        spool = SpoolWriter(run_dir / SPOOL, writer)
        try:
            for first, rows in _checked_batches(path, table, process, types, name):
                spool.append(table, first, rows)
        finally:
            spool.close()
        roles.add(process.role)
    return [role for role in LOOP_ROLES if role in roles]


def _joined_processes(run_dir: Path) -> Iterator[_Process]:
    """Yield the processes that joined a run."""
    for writer, entry in read_object(run_dir / PROCESSES_FILE).items():
        if isinstance(entry, dict) and entry.get("process") in LOOP_ROLES:
            yield _Process(entry["process"], writer)


def _has_secret(folder: Path, process: _Process, source: str) -> bool:
    """Whether a process kept its secret in a folder, so that it ran there."""
    name = f"{KEPT_KEY}.{process.writer}"
    try:
        batches = [*_batches(folder / name, f"{source}: {SPOOL}/{name}")]
    except FileNotFoundError:
        return False
    secrets = (batch.rows.decode(errors="replace") for batch in batches)
    return process.writer in map(writer_of, secrets)


def _batches(path: Path, name: str) -> Iterator[SpoolBatch]:
    """Yield the batches of a file; raise PeerError if no process can have written it."""
    if not stat.S_ISREG(path.lstat().st_mode):
        raise PeerError(f"{name} is not a regular file")
    # It may be replaced by a link or a FIFO meanwhile.
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        try:
            yield from batches_of_file(file, most_bytes=_MOST_BATCH_BYTES)
        except ValueError as error:
            raise PeerError(f"{name} has {error}") from None


def _require_own(table: str, process: _Process, types: Mapping[str, np.dtype[np.void]], name: str) -> None:
    tables = [candidate for candidate in types if OWNER[candidate] == process.role]
    if table not in (*tables, notices_of(process.role), KEPT_REPORT):
        raise PeerError(f"{name}: the {process.role} has no table of this name")


def _checked_batches(
    path: Path,
    table: str,
    process: _Process,
    types: Mapping[str, np.dtype[np.void]],
    name: str,
) -> Iterator[tuple[int, bytes]]:
    """Yield the batches of a file; raise PeerError for one that is not of its process."""
    for batch in _batches(path, name):
        if table == KEPT_REPORT:
            try:
                report = parse_message(ProcessReport, batch.rows).fields()
            except PeerError as error:
                raise PeerError(f"{name}: {error}") from None
            if (report.get("process"), report.get("instance")) != (process.role, process.writer):
                raise PeerError(f"{name} is the report of another process")
        elif table in types and len(batch.rows) % types[table].itemsize:
            raise PeerError(f"{name} is damaged: it has a batch with part of a row")
        yield batch.first, batch.rows


def _require_consistent(before_dir: Path, after_dir: Path, source: str) -> None:
    """Check that each row of a record is in a later one, and that no row was made up.

    Raises:
        PeerError: it is not.
    """
    for before, after in zip(_records(before_dir), _records(after_dir), strict=True):
        for table in before.tables:
            if not _contains(before, after, table):
                raise PeerError(f"{source}: it has other rows of {table} than were recorded")
        for role in LOOP_ROLES:
            reported_rows = after.reports[role]["rows"] if role in after.reports else {}
            counts = after.row_counts(role)
            for table in reported_rows.keys() & counts.keys():
                if (surplus := counts[table] - reported_rows[table]) > 0:
                    raise PeerError(
                        f"{source}: with its rows, {table} has {surplus} more than the {role} reported"
                    )


def _records(run_dir: Path) -> Iterator[RunRecord]:
    """Yield the records of a run: of the network, and of each loop."""
    run = load_run(run_dir)
    yield run.network
    yield from run.loops


def _contains(before: RunRecord, after: RunRecord, table: str) -> bool:
    """Whether each row of a table is, with the same bits, in the table of a later record."""
    batches = after.source.batches(table)
    rows: Rows = np.zeros(0, after.tables[table])
    for old in before.source.batches(table):
        while not len(rows) or rows["input"][-1] < old["input"][-1]:
            if (batch := next(batches, None)) is None:
                return False
            rows = np.concatenate([rows, batch])
        indices = np.searchsorted(rows["input"], old["input"])
        if rows[indices].tobytes() != old.tobytes():
            return False
        rows = rows[indices[-1] :]
    return True


@contextmanager
def _reachable(source: str) -> Iterator[Path]:
    """Give a folder of this host: the source itself, or a copy from another host by scp."""
    host, colon, path = source.partition(":")
    if not colon or "/" in host or Path(source).exists():
        yield Path(source)
        return
    with tempfile.TemporaryDirectory() as folder:
        # A file name may begin with a dash, and a host name must not be taken for an option.
        command = ["scp", "-q", "-r", "--", f"{host}:{path}", f"{folder}/kept"]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except FileNotFoundError:
            raise MachineError(f"{source}: no scp here; copy the folder, and give its path here") from None
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines()
            # ssh's reason is above the last line.
            reason = [line for line in lines if line != "scp: Connection closed"] or ["scp failed"]
            reason = reason[-1]
            raise PeerError(f"{source}: {reason}") from None
        yield Path(folder) / "kept"

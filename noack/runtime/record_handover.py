"""Handing a process's rows over to the recorder, or else to the run directory's spool."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path

from noack.core.errors import MachineError, PeerError
from noack.core.file_access import write_whole
from noack.runtime.control_messages import MissingRows, PersistedAck, parse_message
from noack.runtime.control_plane import ControlPlane, run_name
from noack.runtime.join_ticket import Ticket
from noack.runtime.log_lines import NOTICES, notice_number, notices_of
from noack.runtime.spool import (
    KEPT_KEY,
    KEPT_REPORT,
    RUN_NAME_FILE,
    SPOOL,
    SpoolWriter,
    kept_run_name,
    writer_of,
)
from noack.runtime.telemetry import TelemetryBuffer, first_row

_REPORT_TIMEOUT_S = 5.0
_REPORT_ATTEMPTS = 3


def persisted_rows(plane: ControlPlane, generation: int) -> Mapping[str, Sequence[tuple[int, int]]]:
    """Ranges of this process's rows that are on disk, by table; empty without a new message."""
    message = plane.persisted()
    if message is None:
        return {}
    try:
        acknowledged = parse_message(PersistedAck, message)
    except PeerError:  # not from the recorder
        return {}
    rows: Mapping[str, Sequence[tuple[int, int]]] = acknowledged["rows"]
    return rows if acknowledged["generation"] == generation else {}


def deliver_report(
    plane: ControlPlane, report: Mapping[str, object], telemetry: TelemetryBuffer
) -> bool:
    """Send the final report to the recorder, and again the rows that it misses.

    Rows that a slow recorder misses after that are stored. Return whether nothing is left to do.
    """
    try:
        for _ in range(_REPORT_ATTEMPTS):
            answer = plane.request("report", report, timeout_s=_REPORT_TIMEOUT_S)
            missing = parse_message(MissingRows, answer)["rows"]
            if not missing:
                return True
            telemetry.resend(missing, plane.publish_telemetry_blocking)
        telemetry.store_all()
        report = {**report, "stored": telemetry.stored()}
        plane.request("report", report, timeout_s=_REPORT_TIMEOUT_S)
    except PeerError:
        return False
    return True


class OwnSpool:
    """The rows that a process writes to the run's spool itself; its folder is made with the first.

    Args:
        run_dir: the run's directory.
        role: the process.
        secret: the process's; its files are named after it by `writer_of`.
        kept_of: on another host than the recorder's, the name of the run. The secret is kept there,
            too: it shows that the rows are those of this process.
    """

    def __init__(self, run_dir: Path, role: str, secret: str, kept_of: str | None = None) -> None:
        self._run_dir, self._role, self._secret, self._kept_of = run_dir, role, secret, kept_of

    @cached_property
    def folder(self) -> Path:
        """The folder with the spool."""
        if self._kept_of is None:
            return self._run_dir
        return _kept_folder(self._run_dir, self._kept_of)

    @cached_property
    def _files(self) -> SpoolWriter:
        files = SpoolWriter(self.folder / SPOOL, writer_of(self._secret))
        if self._kept_of is not None:
            files.append(KEPT_KEY, 0, self._secret.encode())
        return files

    def append(self, table: str, header: bytes, payload: bytes) -> None:
        """Write a batch; raise MachineError if it cannot be written."""
        generation, first = first_row(header)
        if table == NOTICES:
            table, first = notices_of(self._role), notice_number(generation, first)
        self._files.append(table, first, payload)

    def keep_report(self, report: Mapping[str, object]) -> None:
        """Write the final report; raise MachineError if it cannot be written."""
        text = json.dumps({**report, "process": self._role})
        self._files.append(KEPT_REPORT, 0, text.encode())


def own_spool(ticket: Ticket, role: str, secret: str) -> OwnSpool:
    """Return the spool of a process: the recorder reads it, or `noack collect` on another host."""
    kept_of = None if ticket.remote is None else run_name(ticket.run_id)
    return OwnSpool(Path(ticket.run_dir), role, secret, kept_of)


def _kept_folder(run_dir: Path, name: str) -> Path:
    """Make the folder of what is kept of a run, with the run's name in it; return its path.

    Runs of two recorders may have begun in the same second: then their directories have one name.
    """
    if kept_run_name(run_dir) not in ("", name):
        run_dir = run_dir.with_name(f"{run_dir.name}-{name}")
    with suppress(MachineError):  # another process may write it, too
        write_whole(run_dir / RUN_NAME_FILE, name)
    return run_dir

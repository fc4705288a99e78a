"""Telemetry on disk: the spool of a run, and which rows of each process it holds."""

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.record.rows import Rows
from netem.core.errors import PeerError
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import LOOP_ROLES, RECORDER, Notice
from noack.runtime.control_messages import LogLine, ProcessReport, parse_message
from noack.runtime.spool import NOTICES, SPOOL, SpoolWriter, lines_in, notices_of
from noack.runtime.telemetry import Ranges, ReceivedRows


class TelemetryStore:
    """Writes batches of rows to the spool, and keeps a list of the rows that it has.

    Args:
        types: the row type of each table of the run.
        run_dir: the run's directory.

    Raises:
        MachineError: the spool cannot be written.
    """

    def __init__(self, types: Mapping[str, np.dtype[np.void]], run_dir: Path) -> None:
        self.types = types
        self.writer = SpoolWriter(run_dir / SPOOL, RECORDER)
        self.writer.prepare([*self.types, *map(notices_of, (*LOOP_ROLES, RECORDER))])
        self._received: defaultdict[tuple[str, str], ReceivedRows] = defaultdict(ReceivedRows)
        """By role and table."""

    def add_notices(self, role: str, first: int, payload: bytes) -> list[dict[str, Any]]:
        """Store a batch of lines of the log; return the fields of each.

        Raise PeerError if the payload has something else.
        """
        lines = [parse_message(LogLine, line).fields() | {"process": role} for line in lines_in(payload)]
        self.writer.append(notices_of(role), first, payload)
        self._received[role, NOTICES].add(first, first + len(lines))
        return lines

    def add_rows(self, role: str, table: str, first: int, payload: bytes) -> tuple[Rows, bool]:
        """Store a batch of rows.

        Returns:
            The rows, and whether they follow the last stored row of their table.

        Raises:
            PeerError: the batch is not from a process of this run.
            ValueError: its length is not a multiple of the row length.
        """
        if table not in self.types or OWNER[table] != role:
            raise PeerError(f"{role} has no table {table}")
        rows: Rows = np.frombuffer(payload, self.types[table])
        if not len(rows):
            raise PeerError("a batch without rows")
        self.writer.append(table, first, payload)
        received = self._received[role, table]
        follows = first == received.end
        received.add(first, first + len(rows))
        return rows, follows

    def add_stored(self, role: str, report: ProcessReport) -> int:
        """Count the rows that a process has stored itself; return the number of new ones."""
        count = 0
        for table, ranges in report.stored.items():
            received = self._received[role, table]
            before = received.count
            for first, end in ranges:
                received.add(first, end)
            count += received.count - before
        return count

    def add_own_notice(self, notice: Notice) -> None:
        """Store a line of the recorder's own for the log."""
        self.writer.append(notices_of(RECORDER), 0, json.dumps(notice.line()).encode())

    def missing(self, role: str, report: ProcessReport) -> dict[str, list[tuple[int, int]]]:
        """Ranges of rows that a process has reported and that are not stored, by table."""
        missing = {
            table: self._received[role, table].missing(total)
            for table, total in report.rows.items()
            if table == NOTICES or OWNER.get(table) == role
        }
        return {table: ranges for table, ranges in missing.items() if ranges}

    def acknowledgements(self) -> Iterator[tuple[str, dict[str, object]]]:
        """Yield, for each role, which of its rows are on disk.

        Raise MachineError if files of the spool were deleted or moved.
        """
        self.writer.require_present()
        rows: defaultdict[str, dict[str, Ranges]] = defaultdict(dict)
        for (role, table), received in self._received.items():
            rows[role][table] = received.ranges
        for role, ranges in rows.items():
            yield role, {"rows": ranges}

"""Telemetry on disk: the spool of a run, and which rows of each process it holds."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cosim.record.run_record import Rows
from noack.core.errors import PeerError
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import GENERATION, LOOP_ROLES, RECORDER, Notice, Start
from noack.runtime.control_messages import LogLine, ProcessReport, parse_message
from noack.runtime.spool import NOTICES, SPOOL, SpoolWriter, lines_in, notice_number, notices_of, read_batches
from noack.runtime.telemetry import ReceivedRows
from noack.scenario.resolution import run_tables
from noack.scenario.scenario import Scenario


class TelemetryStore:
    """Writes batches of rows to the spool, and keeps a list of the rows that it has.

    Args:
        scenario: the resolved scenario.
        run_dir: the run's directory.
        instance: random name of this recorder.
        start: where in the run the recorder begins; a restarted one uses files of its own, as the
            one before it may have left half a batch at the end of its files.

    Raises:
        MachineError: the spool cannot be written.
    """

    def __init__(self, scenario: Scenario, run_dir: Path, instance: str, start: Start) -> None:
        self.types = run_tables(scenario)
        """Row type of each table."""
        self._folder = run_dir / SPOOL
        self.writer = SpoolWriter(self._folder, instance if start.is_restart else RECORDER)
        self.writer.prepare([*self.types, *map(notices_of, (*LOOP_ROLES, RECORDER))])
        self._received: defaultdict[tuple[str, str, int], ReceivedRows] = defaultdict(ReceivedRows)
        """By role, table and generation."""

    def add_notices(self, role: str, generation: int, first: int, payload: bytes) -> list[dict[str, Any]]:
        """Store a batch of lines of the log; return the fields of each.

        Raise PeerError if the payload has something else.
        """
        lines = [parse_message(LogLine, line).fields() | {"process": role} for line in lines_in(payload)]
        self.writer.append(notices_of(role), notice_number(generation, first), payload)
        self._received[role, NOTICES, generation].add(first, first + len(lines))
        return lines

    def add_rows(
        self, role: str, table: str, generation: int, first: int, payload: bytes
    ) -> tuple[Rows, bool]:
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
        if not len(rows) or int(rows["input"][0]) // GENERATION != generation:
            raise PeerError("a batch without rows, or with rows of another process")
        self.writer.append(table, first, payload)
        received = self._received[role, table, generation]
        follows = first == received.end
        received.add(first, first + len(rows))
        return rows, follows

    def add_stored(self, role: str, report: ProcessReport) -> int:
        """Count the rows that a process has stored itself; return the number of new ones."""
        count = 0
        for table, ranges in report.stored.items():
            received = self._received[role, table, report.generation]
            before = received.count
            for first, end in ranges:
                received.add(first, end)
            count += received.count - before
        return count

    def add_own_notice(self, notice: Notice) -> None:
        """Store a line of the recorder's own for the log."""
        self.writer.append(notices_of(RECORDER), 0, json.dumps(notice.line()).encode())

    def load(self, on_rows: Callable[[str, Rows], None]) -> None:
        """Read what an earlier recorder of this run has stored."""
        for table, dtype in self.types.items():
            for first, data in read_batches(self._folder, table):
                if len(data) and len(data) % dtype.itemsize == 0:
                    rows: Rows = np.frombuffer(data, dtype)
                    generation = int(rows["input"][0]) // GENERATION
                    self._received[OWNER[table], table, generation].add(first, first + len(rows))
                    on_rows(table, rows)
        for role in LOOP_ROLES:
            for number, payload in read_batches(self._folder, notices_of(role)):
                generation, first = divmod(number, GENERATION)
                end = first + len(lines_in(payload))
                self._received[role, NOTICES, generation].add(first, end)

    def missing(self, role: str, report: ProcessReport) -> dict[str, list[tuple[int, int]]]:
        """Ranges of rows that a process has reported and that are not stored, by table."""
        missing = {
            table: self._received[role, table, report.generation].missing(total)
            for table, total in report.rows.items()
            if table == NOTICES or OWNER.get(table) == role
        }
        return {table: ranges for table, ranges in missing.items() if ranges}

    def acknowledgements(self) -> Iterator[tuple[str, dict[str, object]]]:
        """Yield, for the newest process of each role, which of its rows are on disk.

        Raise MachineError if files of the spool were deleted or moved.
        """
        self.writer.require_present()
        newest: dict[str, int] = {}
        for role, _, generation in self._received:
            newest[role] = max(newest.get(role, 0), generation)
        for role, generation in newest.items():
            rows = {
                table: received.ranges
                for (owner, table, number), received in self._received.items()
                if (owner, number) == (role, generation)
            }
            yield role, {"generation": generation, "rows": rows}

"""The telemetry of a process: rows of the record, published in batches, and handed over at the end.

Adding a row costs well under a microsecond (one assignment into a preallocated array). Publishing
a batch does not block. The buffer holds a batch until the recorder confirms that it is on disk. At
a limit of memory, it writes the oldest batch to disk itself: a slow recorder costs no rows. At the
end, rows that the recorder misses are sent again; without a recorder they go to the spool.
"""

import json
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.errors import PeerError
from noack.protocol.record_tables import LOOP
from noack.protocol.roles import Notice, Record
from noack.runtime.control_messages import BatchHeader, MissingRows, PersistedAck, parse_message
from noack.runtime.control_plane import ControlPlane
from noack.runtime.spool import KEPT_REPORT, NOTICES, SPOOL, SpoolWriter, batch_of, notices_of, writer_of

_BATCH_ROWS = 256
"""Rows of a table that are sent together."""
_MOST_KEPT_BYTES = 64 * 1024 * 1024
"""Rows that the recorder has not acknowledged yet; more are stored in the process's own spool."""
_RESENT_AT_ONCE = 8  # batches that are sent again at a time: the loop waits for it
Publish = Callable[[str, bytes, bytes], None]  # publishes a batch: table, header (JSON), rows
Ranges = Sequence[tuple[int, int]]
"""Disjoint, ascending, half-open ranges of row numbers."""
_REPORT_TIMEOUT_S = 5.0
_REPORT_ATTEMPTS = 3
"""Longest wait for the answer to the final report, and number of times that missing rows are sent again."""


def contains(ranges: Ranges, first: int, end: int) -> bool:
    """Return whether one of the ranges has all numbers from ``first`` to before ``end``."""
    index = bisect_right(ranges, first, key=lambda entry: entry[0])
    return index > 0 and end <= ranges[index - 1][1]


def overlaps(ranges: Ranges, first: int, end: int) -> bool:
    """Return whether the ranges have one of the numbers from ``first`` to before ``end``."""
    index = bisect_right(ranges, first, key=lambda entry: entry[1])
    return index < len(ranges) and ranges[index][0] < end


class ReceivedRows:
    """Row numbers that have arrived, in any order, as disjoint ranges."""

    def __init__(self) -> None:
        self.ranges: list[tuple[int, int]] = []

    @property
    def end(self) -> int:
        """The highest number plus one."""
        return self.ranges[-1][1] if self.ranges else 0

    @property
    def count(self) -> int:
        """Number of those that have arrived."""
        return sum(end - first for first, end in self.ranges)

    def add(self, first: int, end: int) -> None:
        """Add the numbers from ``first`` to before ``end``."""
        low = bisect_left(self.ranges, first, key=lambda entry: entry[1])
        high = bisect_right(self.ranges, end, key=lambda entry: entry[0])
        if low < high:
            first = min(first, self.ranges[low][0])
            end = max(end, self.ranges[high - 1][1])
        self.ranges[low:high] = [(first, end)]

    def missing(self, total: int) -> list[tuple[int, int]]:
        """The ranges that have not arrived, among ``total`` numbers from 0."""
        edges = [0, *(edge for entry in self.ranges for edge in entry), total]
        gaps = zip(edges[::2], edges[1::2], strict=True)
        return [(low, min(high, total)) for low, high in gaps if low < min(high, total)]


class _RowBatch(NamedTuple):
    table: str
    first: int
    """Number of the first row."""
    rows: int
    payload: bytes


class TelemetryBuffer:
    """Collects rows by table and passes them to ``publish``, which does not block.

    ``persisted`` returns the rows that are on disk, by table, if this was newly confirmed.
    ``store`` writes a batch to disk, or raises MachineError. ``check`` looks at the rows of each table
    as they come, and may return a line for the log.
    """

    def __init__(
        self,
        tables: Mapping[str, np.dtype[np.void]],
        publish: Publish,
        persisted: Callable[[], Mapping[str, Ranges]] = dict,
        store: Publish = lambda table, header, rows: None,
        check: Callable[[str, NDArray[np.void]], Notice | None] | None = None,
    ) -> None:
        self._check = check
        self._publish, self._store = publish, store
        self._stored_rows: dict[str, ReceivedRows] = {}
        self._persisted = persisted
        self._rows = {table: np.zeros(_BATCH_ROWS, dtype) for table, dtype in tables.items()}
        self._row_counts = dict.fromkeys(tables, 0)
        self._lines: list[bytes] = []
        self._row_totals = dict.fromkeys([*tables, NOTICES], 0)
        loop_tables = [table for table, dtype in tables.items() if LOOP in (dtype.names or ())]
        self._by_loop = {table: np.zeros(0, np.int64) for table in loop_tables}
        self._kept_batches: deque[_RowBatch] = deque()
        """The batches that are not known to be on disk, the oldest first."""
        self._to_resend: deque[_RowBatch] = deque()
        self._old_count = 0
        """Number of batches at the front of `_kept_batches` that were there at the last confirmation, too."""
        self._kept_bytes = 0

    def append(self, record: Record) -> None:
        """Add a row; a full batch is published."""
        self.extend_table(record.table, np.array([record.row], self._rows[record.table].dtype))

    def extend_table(self, table: str, rows: NDArray[np.void]) -> None:
        """Add rows of a table; many are published at once."""
        if self._check is not None and (notice := self._check(table, rows)) is not None:
            self.notice(notice)
        if len(rows) >= _BATCH_ROWS:
            self.flush()
            self._publish_rows(table, rows)
            return
        if self._row_counts[table] + len(rows) > _BATCH_ROWS:
            self.flush()
        begin = self._row_counts[table]
        self._rows[table][begin : begin + len(rows)] = rows
        self._row_counts[table] = begin + len(rows)
        if begin + len(rows) == _BATCH_ROWS:
            self.flush()  # all tables: a reader merges them in the order of publication

    def notice(self, notice: Notice) -> None:
        """Add a line for the run's log; many are published together."""
        self._lines.append(json.dumps(notice.line()).encode())
        if len(self._lines) == _BATCH_ROWS:
            self.flush()

    def flush(self) -> None:
        """Publish all collected rows and lines; send again what was lost."""
        for table, count in self._row_counts.items():
            if count:
                self._row_counts[table] = 0
                self._publish_rows(table, self._rows[table][:count])
        if self._lines:
            lines, self._lines = self._lines, []
            self._send(NOTICES, len(lines), batch_of(lines))
        if rows := self._persisted():
            self._forget(rows)
        for _ in range(min(len(self._to_resend), _RESENT_AT_ONCE)):
            batch = self._to_resend.popleft()
            self._publish(batch.table, self._header(batch), batch.payload)

    def totals(self) -> dict[str, int]:
        """Rows published so far, by table."""
        return dict(self._row_totals)

    def totals_by_loop(self) -> dict[str, list[int]]:
        """Rows published so far of each loop, up to the last with rows."""
        return {table: counts.tolist() for table, counts in self._by_loop.items()}

    def store_all(self) -> None:
        """Store all batches that are not known to be on disk."""
        while self._kept_batches:
            self._store_oldest()

    def stored(self) -> dict[str, Ranges]:
        """Ranges of the rows that were stored, by table."""
        return {table: received.ranges for table, received in self._stored_rows.items()}

    def resend(self, missing: Mapping[str, Ranges], publish: Publish) -> int:
        """Publish the kept batches again that overlap missing row ranges; return their number."""
        sent = 0
        for batch in self._kept_batches:
            if overlaps(missing.get(batch.table, ()), batch.first, batch.first + batch.rows):
                publish(batch.table, self._header(batch), batch.payload)
                sent += 1
        return sent

    def _publish_rows(self, table: str, rows: NDArray[np.void]) -> None:
        if table in self._by_loop:
            earlier = self._by_loop[table]
            self._by_loop[table] = counts = np.bincount(rows[LOOP], minlength=len(earlier))
            counts[: len(earlier)] += earlier
        self._send(table, len(rows), rows.tobytes())

    def _send(self, table: str, rows: int, payload: bytes) -> None:
        batch = _RowBatch(table, self._row_totals[table], rows, payload)
        self._row_totals[table] += rows
        self._kept_batches.append(batch)
        self._kept_bytes += len(payload)
        while self._kept_bytes > _MOST_KEPT_BYTES:
            self._store_oldest()
        self._publish(table, self._header(batch), payload)

    def _store_oldest(self) -> None:
        batch = self._kept_batches.popleft()
        self._kept_bytes -= len(batch.payload)
        self._old_count = max(self._old_count - 1, 0)
        self._store(batch.table, self._header(batch), batch.payload)
        stored = self._stored_rows.setdefault(batch.table, ReceivedRows())
        stored.add(batch.first, batch.first + batch.rows)

    def _forget(self, rows: Mapping[str, Ranges]) -> None:
        """Drop batches that are on disk; plan to send older ones again that are not."""
        remaining: deque[_RowBatch] = deque()
        old = 0
        for i, batch in enumerate(self._kept_batches):
            if not contains(rows.get(batch.table, ()), batch.first, batch.first + batch.rows):
                remaining.append(batch)
                old += i < self._old_count
        # Newer batches may have been in flight when the recorder sent its confirmation.
        self._to_resend = deque(islice(remaining, old))
        self._kept_batches, self._old_count = remaining, len(remaining)
        self._kept_bytes = sum(len(batch.payload) for batch in remaining)

    def _header(self, batch: _RowBatch) -> bytes:
        return json.dumps({"first": batch.first, "rows": batch.rows}).encode()


def first_row(header: bytes) -> int:
    """Number of a batch's first row, from its header; raise PeerError if invalid."""
    return parse_message(BatchHeader, header).first


def persisted_rows(plane: ControlPlane) -> Mapping[str, Sequence[tuple[int, int]]]:
    """Ranges of this process's rows that are on disk, by table; empty without a new message."""
    with suppress(PeerError):  # not from the recorder
        if (message := plane.next_persisted_ack()) is not None:
            return parse_message(PersistedAck, message).rows
    return {}


def deliver_report(plane: ControlPlane, report: Mapping[str, object], telemetry: TelemetryBuffer) -> bool:
    """Send the final report to the recorder, and again the rows that it misses.

    Rows that a slow recorder misses after that are stored. Return whether nothing is left to do.
    """
    try:
        for _ in range(_REPORT_ATTEMPTS):
            answer = plane.request("report", report, timeout_s=_REPORT_TIMEOUT_S)
            missing = parse_message(MissingRows, answer).rows
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
    """

    def __init__(self, run_dir: Path, role: str, secret: str) -> None:
        self._run_dir, self._role, self._secret = run_dir, role, secret

    @cached_property
    def files(self) -> SpoolWriter:
        """The files of the spool."""
        return SpoolWriter(self._run_dir / SPOOL, writer_of(self._secret))

    def append(self, table: str, header: bytes, payload: bytes) -> None:
        """Write a batch; raise MachineError if it cannot be written."""
        name = notices_of(self._role) if table == NOTICES else table
        self.files.append(name, first_row(header), payload)

    def keep_report(self, report: Mapping[str, object]) -> None:
        """Write the final report; raise MachineError if it cannot be written."""
        self.files.append(KEPT_REPORT, 0, json.dumps({**report, "process": self._role}).encode())

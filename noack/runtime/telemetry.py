"""The telemetry buffer: rows of the record, gathered in the loop and handed over in batches.

Appending a row costs well under a microsecond (one assignment into a preallocated array); handing a
batch over is one non-blocking publication. A batch is kept until the recorder has said that it is
on disk, up to a bound.
"""

import json
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import islice

import numpy as np

from noack.protocol.machine_interface import GENERATION, Notice, Record
from noack.runtime.control_messages import BatchHeader, parse_message

_BATCH_ROWS = 256
_KEPT_BYTES = 256 * 1024 * 1024
_AGAIN_AT_ONCE = 8
"""Batches that are sent again at a time: the loop waits meanwhile."""

_Batch = tuple[str, int, int, bytes]
"""Table, number of the first row, rows, and the rows themselves."""

Publish = Callable[[str, bytes, bytes], None]
"""Takes a batch: its table, its header (JSON), its rows."""

NOTICES = "notices"

Ranges = Sequence[tuple[int, int]]
"""Half-open ranges of row numbers."""


class ReceivedRows:
    """Row numbers that have arrived, in any order, as few ranges as possible."""

    def __init__(self) -> None:
        self.ranges: list[tuple[int, int]] = []
        """Disjoint, ascending, half-open."""

    @property
    def end(self) -> int:
        """What follows the highest number."""
        return self.ranges[-1][1] if self.ranges else 0

    def add(self, first: int, end: int) -> None:
        """Add the numbers from ``first`` to before ``end``."""
        low = bisect_left(self.ranges, first, key=lambda known: known[1])
        high = bisect_right(self.ranges, end, key=lambda known: known[0])
        if low < high:
            first = min(first, self.ranges[low][0])
            end = max(end, self.ranges[high - 1][1])
        self.ranges[low:high] = [(first, end)]

    def missing(self, total: int) -> list[tuple[int, int]]:
        """The ranges that have not arrived, of ``total`` numbers from 0."""
        edges = [0, *(edge for known in self.ranges for edge in known), total]
        gaps = zip(edges[::2], edges[1::2], strict=True)
        return [(low, min(high, total)) for low, high in gaps if low < min(high, total)]


class TelemetryBuffer:
    """Gathers rows by table.

    Args:
        tables: row type of each table that the process fills.
        publish: takes a full batch; must not block.
        generation: of the process.
        confirmed: asked for rows that are on disk.
    """

    def __init__(
        self,
        tables: Mapping[str, np.dtype[np.void]],
        publish: Publish,
        generation: int = 0,
        confirmed: Callable[[], Mapping[str, Ranges]] = dict,
    ) -> None:
        self._publish = publish
        self._incarnation = generation
        self._confirmed = confirmed
        self._rows = {table: np.zeros(_BATCH_ROWS, dtype) for table, dtype in tables.items()}
        self._filled = dict.fromkeys(tables, 0)
        self._published = dict.fromkeys([*tables, NOTICES], 0)
        self._kept: deque[_Batch] = deque()
        self._lost: deque[_Batch] = deque()
        self._old = 0
        self._kept_bytes = 0

    def append(self, record: Record) -> None:
        """Add a row; a full batch is published."""
        table = record.table
        index = self._filled[table]
        self._rows[table][index] = record.row
        self._filled[table] = index + 1
        if index + 1 == _BATCH_ROWS:
            self.flush()  # all tables, so that a reader can merge them in the order of handing over

    def notice(self, notice: Notice) -> None:
        """Publish a line for the run's log at once."""
        self._send(NOTICES, 1, json.dumps(notice._asdict()).encode())

    def flush(self) -> None:
        """Publish whatever has been gathered."""
        for table, filled in self._filled.items():
            if filled:
                self._hand_over(table)
        if rows := self._confirmed():
            self._forget(rows)
        for _ in range(min(len(self._lost), _AGAIN_AT_ONCE)):
            table, first, count, payload = self._lost.popleft()
            self._publish(table, self._header(first, count), payload)

    def totals(self) -> dict[str, int]:
        """Rows published so far, by table."""
        return dict(self._published)

    def resend(self, missing: Mapping[str, list[tuple[int, int]]], publish: Publish) -> int:
        """Publish kept batches that overlap missing row ranges again.

        Args:
            missing: by table, half-open ranges of row numbers.
            publish: takes the batches; may block.

        Returns:
            How many batches were sent.
        """
        sent = 0
        for table, first, rows, payload in self._kept:
            if any(low < first + rows and first < high for low, high in missing.get(table, ())):
                publish(table, self._header(first, rows), payload)
                sent += 1
        return sent

    def _hand_over(self, table: str) -> None:
        filled = self._filled[table]
        self._filled[table] = 0
        self._send(table, filled, self._rows[table][:filled].tobytes())

    def _send(self, table: str, rows: int, payload: bytes) -> None:
        first = self._published[table]
        self._published[table] = first + rows
        self._kept.append((table, first, rows, payload))
        self._kept_bytes += len(payload)
        while self._kept_bytes > _KEPT_BYTES:
            self._kept_bytes -= len(self._kept.popleft()[3])
            self._old = max(self._old - 1, 0)
        self._publish(table, self._header(first, rows), payload)

    def _forget(self, rows: Mapping[str, Ranges]) -> None:
        """Keep no longer what is on disk; what should be there and is not is sent again."""
        kept: deque[_Batch] = deque()
        old = 0
        for i, batch in enumerate(self._kept):
            table, first, count, _ = batch
            ranges = rows.get(table, ())
            if not any(low <= first and first + count <= high for low, high in ranges):
                kept.append(batch)
                old += i < self._old
        # What the recorder's last word could not know of, may have been under way.
        self._lost = deque(islice(kept, old))
        self._kept, self._old = kept, len(kept)
        self._kept_bytes = sum(len(batch[3]) for batch in kept)

    def _header(self, first: int, rows: int) -> bytes:
        header = {"first": first, "rows": rows, "generation": self._incarnation}
        return json.dumps(header).encode()


def first_row(header: bytes) -> tuple[int, int]:
    """Incarnation and number of a batch's first row, from its header.

    Raises:
        PeerError: it is no header of a batch.
    """
    found = parse_message(BatchHeader, header)
    return found.get("generation", 0), found["first"]


def notice_number(generation: int, first: int) -> int:
    """Number under which a process's notice is spooled; it says of which generation it is."""
    return generation * GENERATION + first


def notices_of(role: str) -> str:
    """Name under which a process's notices are spooled."""
    return f"{NOTICES}_{role}"

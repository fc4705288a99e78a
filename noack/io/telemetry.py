"""The telemetry buffer: rows of the record, gathered in the loop and handed over in batches.

Appending a row costs well under a microsecond (one assignment into a preallocated array); handing a
batch over is one non-blocking publication. Batches are kept until the recorder has confirmed that
it has them all, up to a bound.
"""

import json
from collections import deque
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from noack.io.messages import BatchHeader, heard
from noack.machine import Notice, Record

_BATCH_ROWS = 256
_KEPT_BYTES = 256 * 1024 * 1024

Publish = Callable[[str, bytes, bytes], None]
"""Takes a batch: its table, its header (JSON), its rows."""

NOTICES = "notices"


class TelemetryBuffer:
    """Gathers rows by table.

    Args:
        tables: row type of each table that the process fills.
        publish: takes a full batch; must not block.
    """

    def __init__(self, tables: Mapping[str, np.dtype[np.void]], publish: Publish) -> None:
        self._publish = publish
        self._rows = {table: np.zeros(_BATCH_ROWS, dtype) for table, dtype in tables.items()}
        self._filled = dict.fromkeys(tables, 0)
        self._published = dict.fromkeys([*tables, NOTICES], 0)
        self._kept: deque[tuple[str, int, int, bytes]] = deque()
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
                publish(table, _header(first, rows), payload)
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
        self._publish(table, _header(first, rows), payload)


def _header(first: int, rows: int) -> bytes:
    return json.dumps({"first": first, "rows": rows}).encode()


def first_row(header: bytes) -> int:
    """Number of a batch's first row, from its header.

    Raises:
        PeerError: it is no header of a batch.
    """
    first: int = heard(BatchHeader, header)["first"]
    return first


def notices_of(role: str) -> str:
    """Name under which a process's notices are spooled."""
    return f"{NOTICES}_{role}"


def missing_ranges(got: Iterable[tuple[int, int]], total: int) -> list[tuple[int, int]]:
    """Return what lies between batches, and after the last one.

    Args:
        got: half-open ranges of row numbers that have arrived, in any order.
        total: rows that were sent.
    """
    missing: list[tuple[int, int]] = []
    following = 0
    for first, end in sorted(got):
        if first > following:
            missing.append((following, first))
        following = max(following, end)
    return [*missing, (following, total)] if following < total else missing

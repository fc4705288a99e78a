"""Rows on their way to the recorder: batches, losses, memory, and the handing over at the end."""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.errors import NoAnswerError
from noack.protocol.machine_interface import Notice, Record
from noack.runtime import telemetry
from noack.runtime.spool import NOTICES, kept_run_name, lines_in, notices_of
from noack.runtime.telemetry import (
    OwnSpool,
    ReceivedRows,
    TelemetryBuffer,
    deliver_report,
    first_row,
)

ROW = np.dtype([("number", "<i8"), ("x", "<f8", (2,))])
TABLES = {"one": ROW, "two": ROW}
BATCH = 256


class Wire:
    """Stores the published messages; loses some when told to."""

    def __init__(self) -> None:
        self.batches: list[tuple[str, int, int, bytes]] = []

    def __call__(self, table: str, header: bytes, payload: bytes) -> None:
        fields = json.loads(header)
        assert first_row(header) == (fields["generation"], fields["first"])
        self.batches.append((table, fields["first"], fields["rows"], payload))

    def rows(self, table: str) -> list[tuple[int, Any]]:
        return [(first, np.frombuffer(p, ROW)) for t, first, _, p in self.batches if t == table]


def row(number: int) -> tuple[int, np.ndarray]:
    return number, np.array([number / 2, -number])


def fill(buffer: TelemetryBuffer, numbers: range) -> None:
    """Append rows, ten per batch."""
    for number in numbers:
        buffer.append(Record("one", row(number)))
        if number % 10 == 9:
            buffer.flush()


def test_rows_of_a_table_may_be_added_at_once() -> None:
    wire = Wire()
    buffer = TelemetryBuffer(TABLES, wire)
    rows = np.array([row(number) for number in range(BATCH)], ROW)
    buffer.append(Record("two", row(0)))
    for part in (rows[:100], rows[100:BATCH], rows[:1], rows):
        buffer.extend_table("one", part)
    buffer.flush()
    assert [(table, count) for table, _, count, _ in wire.batches] == [
        ("one", BATCH), ("two", 1), ("one", 1), ("one", BATCH),
    ]  # fmt: skip
    sent = np.concatenate([found for _, found in wire.rows("one")])
    assert sent["number"].tolist() == [*range(BATCH), 0, *range(BATCH)]


def test_a_row_is_copied_when_it_is_appended() -> None:
    wire, x = Wire(), np.array([1.0, 2.0])
    buffer = TelemetryBuffer(TABLES, wire)
    buffer.append(Record("one", (0, x)))
    x[:] = 9.0
    buffer.flush()
    ((_, rows),) = wire.rows("one")
    assert rows["x"].tolist() == [[1.0, 2.0]]


@given(st.integers(1, 6 * BATCH), st.data())
def test_missing_batches_are_sent_again(count: int, data: st.DataObject) -> None:
    wire = Wire()
    buffer = TelemetryBuffer(TABLES, wire)
    flushed = data.draw(st.sets(st.integers(0, count - 1), max_size=5))
    for number in range(count):
        buffer.append(Record("one", row(number)))
        if number in flushed:
            buffer.flush()
    buffer.flush()
    sent = len(wire.batches)
    lost = data.draw(st.sets(st.integers(0, sent - 1)))
    arrived = [batch for k, batch in enumerate(wire.batches) if k not in lost]
    received = ReceivedRows()
    for _, first, n, _ in data.draw(st.permutations(arrived)):
        received.add(first, first + n)
    missing = received.missing(count)
    again = Wire()
    assert buffer.resend({"one": missing}, again) == len(lost) == len(again.batches)
    assert again.batches == [batch for k, batch in enumerate(wire.batches) if k in lost]
    everything = arrived + again.batches
    for _, first, n, _ in again.batches:
        received.add(first, first + n)
    assert received.missing(count) == []
    assert received.ranges == [(0, count)]
    payloads = [p for _, _, _, p in sorted(everything, key=lambda batch: batch[1])]
    rows = np.frombuffer(b"".join(payloads), ROW)
    assert rows["number"].tolist() == list(range(count))


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(1, 8))), st.integers(0, 45))
def test_received_rows_are_stored_as_disjoint_ranges(
    parts: list[tuple[int, int]], total: int
) -> None:
    received, numbers = ReceivedRows(), set[int]()
    for first, count in parts:
        received.add(first, first + count)
        numbers |= set(range(first, first + count))
    assert {n for low, high in received.ranges for n in range(low, high)} == numbers
    assert all(one[1] < other[0] for one, other in pairwise(received.ranges))
    assert received.end == max(numbers, default=-1) + 1
    missing = {n for low, high in received.missing(total) for n in range(low, high)}
    assert missing == set(range(total)) - numbers


def test_batches_on_disk_are_dropped() -> None:
    confirmed: list[dict[str, list[tuple[int, int]]]] = [{}]
    buffer = TelemetryBuffer(TABLES, Wire(), 0, lambda: confirmed[-1])
    fill(buffer, range(30))
    buffer.notice(Notice(0, "info", "hello"))
    confirmed.append({"one": [(0, 10), (12, 30)], NOTICES: [(0, 1)]})
    buffer.flush()
    again = Wire()
    assert buffer.resend({"one": [(0, 30)], NOTICES: [(0, 1)]}, again) == 1
    assert again.batches[0][1:3] == (10, 10)


def test_lost_batches_are_sent_again_during_the_run() -> None:
    confirmed: list[dict[str, list[tuple[int, int]]]] = [{}]
    wire = Wire()
    buffer = TelemetryBuffer(TABLES, wire, 0, lambda: confirmed.pop() if confirmed else {})
    fill(buffer, range(300))
    sent = len(wire.batches)
    confirmed.append({"one": [(0, 50)]})  # a missing batch may be in flight
    buffer.flush()
    assert len(wire.batches) == sent
    fill(buffer, range(300, 310))
    sent = len(wire.batches)
    confirmed.append({"one": [(0, 50), (250, 300)]})
    for _ in range(10):
        before = len(wire.batches)
        buffer.flush()
        assert len(wire.batches) - before <= 8
    assert [first for _, first, _, _ in wire.batches[sent:]] == list(range(50, 250, 10))


class CountedRanges(Sequence[tuple[int, int]]):
    """Ranges (10k, 10k + 5), each read counted."""

    def __init__(self, length: int) -> None:
        self._length, self.reads = length, 0

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, place: Any) -> Any:
        if not 0 <= place < self._length:
            raise IndexError(place)
        self.reads += 1
        return 10 * place, 10 * place + 5


def test_the_work_for_lost_batches_is_not_quadratic() -> None:
    """Thousands of batches may be held; the loop looks through them between its steps."""
    confirmed: list[dict[str, Any]] = []
    buffer = TelemetryBuffer(TABLES, Wire(), 0, lambda: confirmed.pop() if confirmed else {})
    fill(buffer, range(10_000))
    ranges = CountedRanges(1000)
    confirmed.append({"one": ranges})
    buffer.flush()
    assert buffer.resend({"one": ranges}, Wire()) == 1000  # batches of 10 rows, half of them there
    assert ranges.reads < 40 * 1000


def test_log_lines_are_published_in_numbered_batches() -> None:
    wire = Wire()
    buffer = TelemetryBuffer(TABLES, wire)
    buffer.append(Record("one", row(0)))
    for k in range(600):
        buffer.notice(Notice(10 * k, "violation", f"line {k}"))
    buffer.flush()
    batches = [batch for batch in wire.batches if batch[0] == NOTICES]
    assert [(first, rows) for _, first, rows, _ in batches] == [(0, 256), (256, 256), (512, 88)]
    lines = [json.loads(line) for *_, payload in batches for line in lines_in(payload)]
    assert lines[300] == {"t_ns": 3000, "level": "violation", "text": "line 300"}
    assert [line["text"] for line in lines] == [f"line {k}" for k in range(600)]
    assert buffer.totals() == {"one": 1, "two": 0, NOTICES: 600}
    again = Wire()
    buffer.resend({NOTICES: [(300, 301)]}, again)
    assert again.batches == [batches[1]]
    assert len({notices_of(role) for role in ("plant", "sensor", "netem")}) == 3


def test_the_oldest_batch_is_stored_at_the_memory_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(telemetry, "_HELD_BYTES", 25 * ROW.itemsize)
    wire, again, disk = Wire(), Wire(), Wire()
    buffer = TelemetryBuffer(TABLES, wire, store=disk)
    fill(buffer, range(40))
    assert len(wire.batches) == 4  # published anyway
    assert disk.batches == wire.batches[:2]
    assert buffer.stored() == {"one": [(0, 20)]}
    buffer.resend({"one": [(0, 40)]}, again)
    assert [first for _, first, _, _ in again.batches] == [20, 30]
    buffer.store_all()
    assert disk.batches == wire.batches
    assert buffer.stored() == {"one": [(0, 40)]}


NUMBER = np.dtype([("number", "<i8")])


class Plane:
    """A recorder that takes each batch only with its ``takes``-th sending."""

    def __init__(self, takes: int) -> None:
        self._takes, self._sendings = takes, dict[int, int]()
        self._rows = ReceivedRows()
        self.reports: list[dict[str, Any]] = []

    def publish_telemetry_blocking(self, _: str, header: bytes, payload: bytes) -> None:
        first = json.loads(header)["first"]
        self._sendings[first] = self._sendings.get(first, 0) + 1
        if self._sendings[first] >= self._takes:
            self._rows.add(first, first + len(payload) // NUMBER.itemsize)

    def request(self, what: str, report: dict[str, Any], *, timeout_s: float) -> bytes:
        if not self._takes:
            raise NoAnswerError("none")
        self.reports.append(report)
        for first, end in report["stored"].get("one", ()):
            self._rows.add(first, end)
        missing = self._rows.missing(report["rows"]["one"])
        return json.dumps({"rows": {"one": missing} if missing else {}}).encode()


@pytest.mark.parametrize(("takes", "stored"), [(1, []), (2, []), (9, [(0, 30)]), (0, None)])
def test_rows_that_the_recorder_never_takes_are_stored_and_reported(
    takes: int, stored: list[tuple[int, int]] | None
) -> None:
    plane, disk = Plane(takes), list[bytes]()
    buffer = TelemetryBuffer(
        {"one": NUMBER},
        plane.publish_telemetry_blocking,
        store=lambda *batch: disk.append(batch[2]),
    )
    for number in range(30):
        buffer.append(Record("one", (number,)))
        if number % 10 == 9:
            buffer.flush()
    report = {"rows": buffer.totals(), "stored": buffer.stored()}
    assert deliver_report(plane, report, buffer) == (stored is not None)  # type: ignore[arg-type]
    if stored is not None:
        assert plane.reports[-1]["stored"].get("one", []) == stored
        assert len(disk) == len(stored) * 3
        assert len(buffer.stored().get("one", ())) == len(stored)


def test_what_two_runs_with_one_directory_keep_stays_apart(tmp_path: Path) -> None:
    """Runs of two recorders that began in one second, with processes on one host."""
    header = json.dumps({"first": 0}).encode()
    one, again, other = (
        OwnSpool(tmp_path / "run", "sensor", writer, kept_of)
        for writer, kept_of in [("a", "0001"), ("b", "0001"), ("c", "0002")]
    )
    assert not (tmp_path / "run").exists()  # nothing is left of a run that kept nothing
    for spool in (one, again, other):
        spool.append("sensor_event", header, b"rows")
        spool._files.close()
    assert one.folder == again.folder == tmp_path / "run"
    assert other.folder == tmp_path / "run-0002"
    assert [kept_run_name(found) for found in (one.folder, other.folder)] == ["0001", "0002"]
    assert len(list((one.folder / "spool").glob("sensor_event.*"))) == 2
    assert len(list((other.folder / "spool").glob("sensor_event.*"))) == 1

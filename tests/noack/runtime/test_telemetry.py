"""Rows on their way to the recorder and in its spool: batches, losses, memory, damaged files."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core.errors import MachineError, NoAnswerError
from noack.protocol.roles import Notice, Record
from noack.runtime import telemetry
from noack.runtime.spool import NOTICES, SpoolWriter, read_batches
from noack.runtime.telemetry import ReceivedRows, TelemetryBuffer, deliver_report, first_row

ROW = np.dtype([("number", "<i8"), ("x", "<f8", (2,))])
TABLES = {"one": ROW, "two": ROW}
BATCH = 256


class Wire:
    """Stores the published messages; loses some when told to."""

    def __init__(self) -> None:
        self.batches: list[tuple[str, int, int, bytes]] = []

    def __call__(self, table: str, header: bytes, payload: bytes) -> None:
        fields = json.loads(header)
        assert first_row(header) == fields["first"]
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


def test_lost_batches_are_sent_again_during_the_run() -> None:
    confirmed: list[dict[str, list[tuple[int, int]]]] = [{}]
    wire = Wire()
    buffer = TelemetryBuffer(TABLES, wire, lambda: confirmed.pop() if confirmed else {})
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


def test_the_oldest_batch_is_stored_at_the_memory_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(telemetry, "_MOST_KEPT_BYTES", 25 * ROW.itemsize)
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


def test_lines_and_rows_that_come_at_once_are_published_in_numbered_batches() -> None:
    wire = Wire()
    buffer = TelemetryBuffer(TABLES, wire)
    for k in range(300):
        buffer.notice(Notice(10 * k, "violation", f"line {k}"))
    buffer.extend_table("one", np.zeros(BATCH, ROW))
    buffer.flush()
    assert sorted(batch[:3] for batch in wire.batches) == sorted(
        [(NOTICES, 0, 256), (NOTICES, 256, 44), ("one", 0, BATCH)]
    )


def spool(folder: Path, writer: str, table: str, *batches: tuple[int, bytes]) -> Path:
    with_writer = SpoolWriter(folder, writer)
    for first, payload in batches:
        with_writer.append(table, first, payload)
    with_writer.close()
    return folder / f"{table}.{writer}"


def test_the_file_is_the_documented_sequence_of_batches(tmp_path: Path) -> None:
    path = spool(tmp_path, "recorder", "plant_step", (7, b"abc"), (8, b"de"))
    expected = struct.pack("<QQ", 7, 3) + b"abc" + struct.pack("<QQ", 8, 2) + b"de"
    assert path.read_bytes() == expected


def test_an_incomplete_batch_is_ignored(tmp_path: Path) -> None:
    batches = [(0, b"first"), (5, b"second")]
    path = spool(tmp_path, "recorder", "plant_step", *batches)
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert list(read_batches(tmp_path, "plant_step")) == batches[: int(size >= 16 + 5)]
    path.write_bytes(whole + struct.pack("<QQ", 11, 2**62))  # a damaged length takes no memory
    assert list(read_batches(tmp_path, "plant_step")) == batches


@pytest.mark.parametrize("what", ["deleted", "moved", "replaced", "folder"])
def test_files_that_are_deleted_meanwhile_are_noticed(tmp_path: Path, what: str) -> None:
    folder = tmp_path / "spool"
    writer = SpoolWriter(folder, "recorder")
    writer.prepare(["step", "other"])
    writer.append("step", 0, b"abc")
    writer.require_present()
    path = folder / "step.recorder"
    if what == "folder":
        shutil.rmtree(folder)
    elif what == "moved":
        path.rename(tmp_path / "elsewhere")
    else:
        path.unlink()
        if what == "replaced":
            path.write_bytes(b"")
    writer.append("step", 3, b"de")  # the write succeeds, but the file has no name
    with pytest.raises(MachineError, match=r"/step\.recorder: was deleted or moved"):
        writer.require_present()
    writer.close()

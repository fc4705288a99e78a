"""Handing a process's rows over: to a recorder that takes them, one that loses them, and none."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.core.errors import NoAnswerError
from noack.protocol.machine_interface import Record
from noack.runtime.spool import kept_run_name
from noack.runtime.telemetry import OwnSpool, ReceivedRows, TelemetryBuffer, deliver_report

ROW = np.dtype([("number", "<i8")])


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
            self._rows.add(first, first + len(payload) // ROW.itemsize)

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
        {"one": ROW}, plane.publish_telemetry_blocking, store=lambda *batch: disk.append(batch[2])
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

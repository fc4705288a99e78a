"""The recorder: invalid telemetry, full disks, and progress."""

import errno
import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from cosim.live.recording.recorder import Recorder
from cosim.output.viewer.loop_recording import ViewError
from cosim.record.rows import with_loop
from cosim.record.run_directory import SCENARIO_FILE
from cosim.record.run_record import RunRecord
from cosim.record.spool_conversion import finish_record
from netem.core.errors import MachineError
from noack.protocol.record_tables import OWNER, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.roles import LOOP_ROLES, RECORDER
from noack.runtime.control_messages import RunProgress, parse_message
from noack.runtime.spool import NOTICES, SPOOL, read_batches
from noack.runtime.telemetry import OwnSpool
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, validate
from tests.cosim.simulation.outage import with_outage
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.helpers.shipped import resolved


class RecordingPlane(FakePlane):
    """A control plane that stores the recorder's reports."""

    def __init__(self) -> None:
        super().__init__()
        self.reports: list[RunProgress] = []

    def publish(self, *parts: str, content: Any) -> None:
        assert parts == ("progress",)
        self.reports.append(parse_message(RunProgress, content))


class Run:
    """A run directory and its recorder."""

    def __init__(self, scenario: Scenario, run_dir: Path) -> None:
        self.scenario, self.run_dir = scenario, run_dir
        (run_dir / SCENARIO_FILE).write_text(dumps(scenario))
        self.sent: dict[str, int] = {}
        self.plane = plane = RecordingPlane()
        self.recorder = Recorder(ResolvedRun(scenario), run_dir, plane)  # type: ignore[arg-type]
        for role in LOOP_ROLES:
            plane.put("alive", Sample(f"noack/0/alive/{role}/{role}"))
        self.recorder.poll()

    def send(self, table: str, first: int, payload: bytes, role: str) -> None:
        header = json.dumps({"first": first}).encode()
        self.plane.put("telemetry", Sample(f"t/{role}/{table}", payload, header))
        self.recorder.poll()

    def send_until(self, record: RunRecord, until_ns: int) -> None:
        """Send what the processes have recorded since the last call, up to a time."""
        for table in record.tables:
            first = self.sent.get(table, 0)
            self.sent[table] = int(np.searchsorted(record[table]["now_ns"], until_ns))
            if len(rows := record[table][first : self.sent[table]]):
                sent = with_loop(rows, 0, ResolvedRun(record.scenario).tables[table])
                self.send(table, first, sent.tobytes(), OWNER[table])

    def rows(self, table: str, count: int) -> None:
        rows = np.zeros(count, self.recorder.store.types[table])
        rows["input"] = np.arange(count)
        self.send(table, 0, rows.tobytes(), OWNER[table])

    def report(self, role: str, stored: Any = None, instance: str = "", **rows: int) -> Any:
        tables = {table: 0 for table in OWNER if OWNER[table] == role}
        report = {
            "ended": "horizon", "channel": {}, "rows": tables | {NOTICES: 0} | rows,
            "instance": instance or role, "stored": stored or {},
        }  # fmt: skip
        query = Query(f"report/{role}", json.dumps(report).encode())
        self.plane.put("report", query)
        self.recorder.poll()
        return json.loads(query.replies[0])["rows"]

    def finished(self) -> RunRecord:
        """The record after the end of the recorder."""
        self.recorder.finish()
        self.recorder.report()
        return finish_record(self.run_dir).loop()


@pytest.fixture
def run(content: dict[str, Any], tmp_path: Path) -> Iterator[Run]:
    opened_run = Run(resolve(validate(content, "")), tmp_path)
    yield opened_run
    opened_run.recorder.store.writer.close()


def test_rows_that_a_process_has_stored_are_not_requested_and_are_logged(run: Run) -> None:
    run.rows(PLANT_STEP, 5)
    stored = {PLANT_STEP: [[3, 7], [8, 10]]}
    assert run.report("plant", stored=stored, **{PLANT_STEP: 10}) == {PLANT_STEP: [[7, 8]]}
    ((_, line),) = read_batches(run.run_dir / SPOOL, f"{NOTICES}_{RECORDER}")
    assert "plant wrote 4 rows to disk itself, because the recorder was slow" in line.decode()


def test_a_process_that_left_the_start_barrier_is_gone_once_the_one_in_its_place_has_reported(
    run: Run,
) -> None:
    vanished = Sample("noack/0/alive/plant/plant")
    vanished.kind = zenoh.SampleKind.DELETE  # type: ignore[assignment]
    run.plane.put("alive", vanished)
    for role in set(LOOP_ROLES) - {"plant"}:
        assert run.report(role) == {}
    assert not run.recorder.finished  # it may come back
    run.plane.put("alive", Sample("noack/0/alive/plant/plant2"))
    run.recorder.poll()
    assert not run.recorder.finished
    assert run.report("plant", instance="plant2") == {}
    assert run.recorder.finished


def test_a_process_that_wrote_its_report_to_the_spool_is_done_once_it_is_gone(run: Run) -> None:
    for role in set(LOOP_ROLES) - {"plant"}:
        assert run.report(role) == {}
    kept = {"ended": "horizon", "channel": {}, "rows": {}, "instance": "plant"}
    spool = OwnSpool(run.run_dir, "plant", "secret")
    spool.keep_report(kept)
    spool.files.close()
    run.recorder.note_stored()
    assert not run.recorder.finished  # it may be one of an earlier process
    vanished = Sample("noack/0/alive/plant/plant")
    vanished.kind = zenoh.SampleKind.DELETE  # type: ignore[assignment]
    run.plane.put("alive", vanished)
    run.recorder.poll()
    run.recorder.note_stored()
    assert run.recorder.finished


def test_a_deleted_spool_file_is_reported(run: Run) -> None:
    run.rows(PLANT_STEP, 2)
    file = run.run_dir / SPOOL / f"{PLANT_STEP}.{RECORDER}"
    file.unlink()
    with pytest.raises(MachineError, match=f"^{file}: was deleted or moved during the run$"):
        run.recorder.acknowledge()
    run.recorder.finish()
    assert "was deleted or moved" in str(run.recorder.lost)


def test_a_log_on_a_full_disk_does_not_stop_the_record(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The view fails first; reporting the failure must not raise another error."""

    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("sys.stderr", Full())
        run.recorder.give_up_view(ViewError("no space left"))
        run.send("junk", 0, b"", "plant")
    run.rows(PLANT_STEP, 3)
    assert len(list(read_batches(run.run_dir / SPOOL, PLANT_STEP))) == 1


# --- progress -------------------------------------------------------------------------------------


def test_the_progress_has_the_largest_lateness_and_state(tmp_path: Path) -> None:
    """The controller stands still from 0.5 s to 0.7 s."""
    record = with_outage(resolved("lane_following", "horizon_s=1"), 0.5, 0.7)
    late = Run(record.scenario, tmp_path)
    for until_ns in range(100_000_000, 1_200_000_000, 100_000_000):
        late.send_until(record, until_ns)
        late.recorder.show()
    late_us = [report.late_us for report in late.plane.reports]
    assert late_us[:4] == [0.0] * 4
    assert late_us[-1] == pytest.approx(200e3, abs=5e3)
    assert late.plane.reports[-1].x_norm == np.linalg.norm(record[SENSOR_MEASUREMENT]["x"][-1])
    assert late.finished().notices == []

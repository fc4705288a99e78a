"""The recorder: invalid telemetry, full disks, and claims that become void in the run."""

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

from cosim.live.recording import recorder
from cosim.live.recording.recorder import Recorder
from cosim.output.viewer.loop_recording import ViewError
from cosim.record.record_source import with_loop
from cosim.record.run_directory import SCENARIO_FILE
from cosim.record.run_record import RunRecord, load_record
from cosim.record.spool_conversion import finish_record
from noack.core.errors import MachineError
from noack.protocol.record_tables import OWNER, PLANT_STEP
from noack.protocol.roles import LOOP_ROLES, RECORDER
from noack.runtime.control_messages import RunProgress, parse_message
from noack.runtime.spool import NOTICES, SPOOL, read_batches
from noack.scenario.resolution import resolve, run_tables
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, validate
from tests.cosim.simulation.outage import with_outage
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.helpers.run_descriptors import JUNK
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
        self.recorder = Recorder(scenario, run_dir, plane)  # type: ignore[arg-type]
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
                sent = with_loop(rows, 0, run_tables(record.scenario)[table])
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

    @property
    def warnings(self) -> list[list[str]]:
        return [report.warnings for report in self.plane.reports]


@pytest.fixture
def run(content: dict[str, Any], tmp_path: Path) -> Iterator[Run]:
    opened_run = Run(resolve(validate(content, "")), tmp_path)
    yield opened_run
    opened_run.recorder.store.writer.close()


def test_invalid_telemetry_is_ignored_and_the_rest_is_stored(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    row = np.zeros(1, run.recorder.store.types[PLANT_STEP]).tobytes()
    header = b'{"first": 0, "rows": 1}'
    for junk in JUNK:
        run.plane.put("telemetry", Sample("t/plant/plant_step", junk, header))
        run.plane.put("telemetry", Sample("t/plant/plant_step", row, junk))
        run.plane.put("telemetry", Sample("t/sensor/plant_step", row, header))
        run.plane.put("telemetry", Sample("t/plant/notices", junk, header))
        run.plane.put("telemetry", Sample("t/plant/plant_step", row, header, "t/plant/plant_x"))
        run.plane.put("report", bad := Query("report/plant", junk))
        run.recorder.poll()
        assert bad.error is not None
    run.rows(PLANT_STEP, 1)
    assert len(run.finished()[PLANT_STEP]) == 1
    assert capsys.readouterr().err.count("ignored an invalid telemetry message") == 1


def test_rows_that_a_process_has_stored_are_not_requested_and_are_logged(run: Run) -> None:
    run.rows(PLANT_STEP, 5)
    stored = {PLANT_STEP: [[3, 7], [8, 10]]}
    assert run.report("plant", stored=stored, **{PLANT_STEP: 10}) == {PLANT_STEP: [[7, 8]]}
    ((_, line),) = read_batches(run.run_dir / SPOOL, f"{NOTICES}_{RECORDER}")
    assert "plant: 4 rows were written to disk by itself" in line.decode()


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


# --- claims ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def outage() -> RunRecord:
    """The controller stands still from 0.5 s to 0.7 s."""
    return with_outage(resolved("lane_following", "horizon_s=1"), 0.5, 0.7)


@pytest.fixture
def late(outage: RunRecord, tmp_path: Path) -> Run:
    return Run(outage.scenario, tmp_path)


def test_a_violation_is_reported_once_and_recorded(outage: RunRecord, late: Run) -> None:
    for until_ns in range(100_000_000, 1_200_000_000, 100_000_000):
        late.send_until(outage, until_ns)
        late.recorder.show()
    cause = "an input was 0.101 s old, 0.007 s allowed (worst 0.092 s later)"
    limit = "there are certificates for up to 0.06441 s, if nothing else is later than allowed"
    line = f"later than allowed from 0.506 s on: {cause}; {limit}"
    assert late.warnings == [[]] * 5 + [[line]] * 6
    notices = late.finished().notices
    assert notices == [{"t_ns": 506_000_000, "level": "late", "text": line, "process": "recorder"}]
    assert load_record(late.run_dir).notices == notices


@pytest.mark.parametrize("is_stopping", [False, True])
def test_a_violation_found_at_the_end_is_reported_unless_the_run_was_stopped(
    outage: RunRecord, late: Run, is_stopping: bool
) -> None:
    late.recorder.is_stopping = is_stopping
    late.send_until(outage, 1_200_000_000)
    notices = late.finished().notices
    assert len(notices) == (not is_stopping)
    assert [notice for notice in late.warnings if notice] == [[notice["text"]] for notice in notices]


def test_of_many_warnings_the_last_names_the_place_of_the_others() -> None:
    report = recorder.ProgressReport(
        t_s=0.0, events=0, deliveries=0, longest_loss_burst=0, x_norm=None, live=None
    )
    for number in range(40):
        report.add_warning(f"warning {number}")
    assert report.warnings[:-1] == [f"warning {number}" for number in range(30)]
    assert report.warnings[-1].endswith("are in the logs of the loops")


def test_missing_rows_are_reported_as_an_unknown_result(outage: RunRecord, late: Run) -> None:
    late.send_until(outage, 300_000_000)
    late.sent["sensor_measurement"] += 10  # a batch is lost and sent again at the end
    late.send_until(outage, 1_200_000_000)
    late.recorder.show()
    late.recorder.show()
    assert late.warnings[-1] == [
        "claims are checked after the run only: telemetry is missing or arrived out of order"
    ]
    assert late.finished().notices == []

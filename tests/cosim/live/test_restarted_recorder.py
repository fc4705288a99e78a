"""A restarted recorder continues from the state of the one before it."""

import errno
import json
import os
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from cosim.live import recorder
from cosim.live.recorder import Recorder
from cosim.output.viewer.recording import ViewError
from cosim.record.run_directory import SCENARIO_FILE
from noack.core.errors import MachineError
from noack.protocol.machine_interface import BEGINNING, GENERATION, Start
from noack.protocol.record_tables import OWNER, PLANT_STEP, SENSOR_MEASUREMENT
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.spool import NOTICES, SPOOL, batch_of, read_chunks
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import dumps, validate
from tests.fuzz.plane import FakePlane, Query, Sample


class Run:
    """A run directory and its successive recorders."""

    def __init__(self, content: dict[str, Any], run_dir: Path) -> None:
        self.scenario, self.run_dir = resolve(validate(content, "")), run_dir
        (run_dir / SCENARIO_FILE).write_text(dumps(self.scenario))
        self.begin(BEGINNING, "f")

    def begin(self, start: Start, instance: str, present: Sequence[str] = LOOP_ROLES) -> None:
        self.plane = plane = FakePlane()
        plane.instance = instance
        self.recorder = Recorder(
            self.scenario,
            self.run_dir,
            plane,
            start=start,  # type: ignore[arg-type]
        )
        for role in present:
            plane.put("alive", Sample(f"noack/0/alive/{role}/{role}"))
        self.recorder.poll()

    def follow(self, start: Start, instance: str, present: Sequence[str] = LOOP_ROLES) -> None:
        self.recorder.store.writer.close()
        self.begin(start, instance, present)

    def send(self, table: str, first: int, payload: bytes, role: str, generation: int = 0) -> None:
        header = json.dumps({"first": first, "generation": generation}).encode()
        self.plane.put("telemetry", Sample(f"t/{role}/{table}", payload, header))
        self.recorder.poll()

    def rows(self, table: str, count: int, generation: int = 0) -> None:
        rows = np.zeros(count, self.recorder.store.types[table])
        rows["input"] = generation * GENERATION + np.arange(count)
        self.send(table, 0, rows.tobytes(), OWNER[table], generation)

    def notices(self, role: str, count: int, generation: int = 0) -> None:
        line = json.dumps({"t_ns": 0, "level": "info", "text": role}).encode()
        self.send(NOTICES, 0, batch_of([line] * count), role, generation)

    def report(
        self,
        role: str,
        generation: int = 0,
        stored: dict[str, Any] | None = None,
        instance: str = "",
        **rows: int,
    ) -> Any:
        tables = {table: 0 for table in OWNER if OWNER[table] == role}
        report = {
            "ended": "horizon", "channel": {}, "rows": tables | {NOTICES: 0} | rows,
            "generation": generation, "instance": instance or role, "stored": stored or {},
        }  # fmt: skip
        query = Query(f"report/{role}", json.dumps(report).encode())
        self.plane.put("report", query)
        self.recorder.poll()
        return json.loads(query.replies[0])["rows"]


@pytest.fixture
def run(content: dict[str, Any], tmp_path: Path) -> Iterator[Run]:
    found = Run(content, tmp_path)
    yield found
    found.recorder.store.writer.close()


def test_a_restarted_recorder_requests_no_rows_that_are_on_disk(run: Run) -> None:
    run.rows(PLANT_STEP, 5)
    run.notices("plant", 3)
    run.notices("sensor", 1, generation=1)
    run.follow(Start(1, 0), "a")
    assert run.report("plant", **{PLANT_STEP: 5, NOTICES: 3}) == {}
    assert run.report("sensor", 1, **{NOTICES: 1}) == {}
    assert run.report("controller", **{NOTICES: 1}) == {NOTICES: [[0, 1]]}


def test_rows_that_a_process_has_stored_are_not_requested_and_are_logged(run: Run) -> None:
    run.rows(PLANT_STEP, 5)
    stored = {PLANT_STEP: [[3, 7], [8, 10]]}
    assert run.report("plant", stored=stored, **{PLANT_STEP: 10}) == {PLANT_STEP: [[7, 8]]}
    ((_, line),) = read_chunks(run.run_dir / SPOOL, f"{NOTICES}_{RECORDER}")
    assert "plant: 4 rows were written to disk by itself" in line.decode()


def test_a_process_gets_the_acknowledgement_of_its_own_rows_only(run: Run) -> None:
    run.rows(SENSOR_MEASUREMENT, 7)
    run.follow(Start(1, 0), "b")
    run.rows(SENSOR_MEASUREMENT, 3, generation=1)
    run.follow(Start(2, 0), "a")
    run.rows(PLANT_STEP, 2)
    run.recorder.acknowledge()
    assert run.plane.acknowledged["sensor"] == {
        "generation": 1,
        "rows": {SENSOR_MEASUREMENT: [[0, 3]]},
    }
    assert run.plane.acknowledged["plant"] == {"generation": 0, "rows": {PLANT_STEP: [[0, 2]]}}


def test_a_restarted_recorder_does_not_wait_for_ended_processes(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.follow(Start(1, 0), "a")
    assert not run.recorder.finished
    for role in LOOP_ROLES:
        assert run.report(role) == {}
    assert run.recorder.finished
    run.follow(Start(2, 0), "b", present=["plant"])
    assert not run.recorder.finished
    monkeypatch.setattr(recorder, "_DISCOVERY_S", -1.0)
    assert not run.recorder.finished
    assert run.report("plant") == {}
    assert run.recorder.finished


def test_a_process_is_gone_once_the_one_that_replaced_it_has_reported(run: Run) -> None:
    gone = Sample("noack/0/alive/plant/plant")
    gone.kind = zenoh.SampleKind.DELETE  # type: ignore[assignment]
    run.plane.put("alive", gone)
    for role in set(LOOP_ROLES) - {"plant"}:
        assert run.report(role) == {}
    assert not run.recorder.finished  # it may come back
    run.plane.put("alive", Sample("noack/0/alive/plant/plant2"))
    run.recorder.poll()
    assert not run.recorder.finished
    assert run.report("plant", generation=1, instance="plant2") == {}
    assert run.recorder.finished


def test_a_deleted_spool_file_is_reported(run: Run) -> None:
    run.rows(PLANT_STEP, 2)
    file = run.run_dir / SPOOL / f"{PLANT_STEP}.{RECORDER}"
    file.unlink()
    with pytest.raises(MachineError, match=f"^{file}: was deleted or moved during the run$"):
        run.recorder.acknowledge()
    run.recorder.finish()
    assert "was deleted or moved" in str(run.recorder.lost)


def test_a_log_on_a_full_disk_does_not_stop_the_record(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The view fails first; reporting the failure must not raise another error."""

    class Full(StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("sys.stderr", Full())
        run.recorder.give_up_view(ViewError("no space left"))
        run.send("junk", 0, b"", "plant")
    run.rows(PLANT_STEP, 3)
    assert len(list(read_chunks(run.run_dir / SPOOL, PLANT_STEP))) == 1

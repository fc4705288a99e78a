"""An invalid control message is refused or ignored, and all processes continue."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from cosim.live import coordinator
from cosim.live.recorder import Recorder
from cosim.record.run_directory import SCENARIO_FILE
from cosim.record.spool_conversion import finish_record
from noack.protocol.record_tables import PLANT_STEP
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.join_ticket import new_ticket
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import dumps, validate
from tests.fuzz.plane import FakePlane, Query, Sample

JUNK: list[bytes | None] = [
    None, b"", b"{", b"\xff", b"[]", b"{}", b"null", b'{"rows": 1}', b"[" * 100_000,
    b'{"pid": 1, "address": ["127.0.0.1", 0]}', b'{"pid": 1, "address": null}',
]  # fmt: skip


def test_an_invalid_request_is_refused_and_the_others_join(
    content: dict[str, Any], tmp_path: Path
) -> None:
    plane = FakePlane()
    ticket = new_ticket(resolve(validate(content, "")), tmp_path, launched=True)
    with patch.object(coordinator, "ControlPlane", lambda *_, **__: plane):
        barrier = coordinator.Coordinator(ticket)
    for junk in JUNK:
        plane.put("progress", Sample("progress", junk))
        assert barrier.progress() is None
        for question in ("admit", "join"):
            bad = Query(f"noack/0/{question}/plant", junk)
            plane.put(question, bad)
            barrier.poll()
            assert bad.error is not None
            assert bad.error.startswith("cannot join: ")
    for number, role in enumerate((*LOOP_ROLES, RECORDER)):
        address = None if role == RECORDER else ["127.0.0.1", 1 + number]
        hello = {"instance": role, "address": address, "admission_pass": ticket.admission_pass}
        request = json.dumps(hello).encode()
        for question in ("admit", "join"):
            plane.put(question, Query(f"noack/0/{question}/{role}", request))
            barrier.poll()
    assert barrier.epoch_ns is not None
    assert plane.answers[-1].addresses.keys() == set(LOOP_ROLES)


def test_the_recorder_ignores_invalid_telemetry_and_stores_the_rest(
    content: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, plane = resolve(validate(content, "")), FakePlane()
    (tmp_path / SCENARIO_FILE).write_text(dumps(scenario))
    recorder = Recorder(scenario, tmp_path, plane)  # type: ignore[arg-type]
    row = np.zeros(1, recorder.store.types[PLANT_STEP]).tobytes()
    header = b'{"first": 0, "rows": 1}'
    for junk in JUNK:
        plane.put("telemetry", Sample("t/plant/plant_step", junk, header))
        plane.put("telemetry", Sample("t/plant/plant_step", row, junk))
        plane.put("telemetry", Sample("t/sensor/plant_step", row, header))
        plane.put("telemetry", Sample("t/plant/notices", junk, header))
        plane.put("telemetry", Sample("t/plant/plant_step", row, header, "t/plant/plant_x"))
        bad = Query("report/plant", junk)
        plane.put("report", bad)
        recorder.poll()
        assert bad.error is not None
    plane.put("telemetry", Sample("t/plant/plant_step", row, header))
    recorder.poll()
    recorder.finish()
    recorder.report()
    assert len(finish_record(tmp_path).loop()[PLANT_STEP]) == 1
    assert capsys.readouterr().err.count("ignored an invalid telemetry message") == 1

"""Messages to the recorder: batches, notices and final reports from any sender on the plane."""

import io
import json
import shutil
from contextlib import redirect_stderr
from typing import Any

import numpy as np

from cosim.live.recorder import Recorder
from cosim.record.run_directory import SCENARIO_FILE
from cosim.record.spool_conversion import finish_record
from noack.protocol.record_tables import OWNER
from noack.runtime.spool import NOTICES, batch_of
from noack.scenario.resolution import resolve, run_tables
from noack.scenario.scenario_file import dumps, validate
from tests.fuzz.choices import Choices
from tests.fuzz.edits import Vocabulary, edited
from tests.fuzz.harness import workspace
from tests.fuzz.parsers.record import NOTICE, SCENARIO
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.fuzz.tables import damaged

RESOLVED = resolve(validate(SCENARIO, "short"))
REPORT = {
    "pid": 1, "ended": "horizon", "realtime": {},
    "channel": {"accepted": 1, "rejected": {"tag": 1}},
    "rows": {"plant_step": 4, "plant_actuation": 0, "notices": 1}, "generation": 0,
    "instance": "one",
}  # fmt: skip
_TYPES = run_tables(RESOLVED)
HEADER = {"first": 0, "rows": 4, "generation": 0}
KNOWN = Vocabulary(
    (*REPORT, *HEADER, *NOTICE, *OWNER, "accepted", "rejected"), (*OWNER, "horizon", "violation")
)


def one_input(data: bytes) -> None:
    choices = Choices(data)
    run_dir = workspace() / "telemetry"
    shutil.rmtree(run_dir, ignore_errors=True)
    run_dir.mkdir()
    (run_dir / SCENARIO_FILE).write_text(dumps(RESOLVED))
    plane = FakePlane()
    recorder = Recorder(RESOLVED, run_dir, plane)
    queries = []
    for _ in range(1 + choices.below(6)):
        match choices.below(5):
            case 0:
                queries.append(_report(choices))
                plane.put("report", queries[-1])
            case 1:
                plane.put(
                    "alive", Sample(f"noack/0/alive/{choices.one([*OWNER.values(), ''])}/one")
                )
            case _:
                plane.put("telemetry", _batch(choices))
    with redirect_stderr(io.StringIO()) as errors:
        recorder.poll()
    assert errors.getvalue().count("\n") <= 1, "invalid messages fill the log"
    recorder.show()
    recorder.acknowledge()
    assert isinstance(recorder.finished, bool)
    assert all(query.answered == 1 for query in queries), "a report has no answer"
    # The record contains the valid part of the messages.
    recorder.finish()
    recorder.report()
    record = finish_record(run_dir).loop()
    assert set(record.tables) >= {"plant_step"}


def _batch(choices: Choices) -> Sample:
    table = choices.one([*OWNER, NOTICES, "", "nothing"])
    role = choices.one([OWNER.get(table, "plant"), "nobody"])
    if table == NOTICES:
        lines = [edited(choices, NOTICE, KNOWN) for _ in range(1 + choices.below(3))]
        payload = batch_of(json.dumps(line).encode() for line in lines)
    else:
        count = choices.below(3)
        numbers = [choices.integer() % 2**63 if choices.below(4) == 0 else 0 for _ in range(8)]
        payload = np.resize(np.array(numbers, "<i8"), 64 * count).tobytes()
        types = _TYPES.get(table)
        if types is not None and choices.below(4):
            payload = payload[: types.itemsize * choices.below(4)]
    header = json.dumps(edited(choices, HEADER, KNOWN)).encode()
    attachment = None if choices.below(8) == 1 else damaged(choices, header)
    payload = damaged(choices, payload) if payload else payload
    return Sample(f"noack/0/telemetry/{role}/{table}", payload, attachment)


def _report(choices: Choices) -> Query:
    report: Any = edited(choices, REPORT, KNOWN)
    payload = None if choices.below(8) == 1 else damaged(choices, json.dumps(report).encode())
    return Query(f"noack/0/report/{choices.one([*OWNER.values(), 'nobody'])}", payload)

"""The recorder and the terminal report void claims during the run."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.loop_statistics import list_violations
from cosim.analysis.run_summary import summarise
from cosim.live.progress import progress_line
from cosim.live.recorder import Recorder
from cosim.record.record_source import with_loop
from cosim.record.run_directory import SCENARIO_FILE
from cosim.record.run_record import RunRecord, load_record
from cosim.record.spool_conversion import finish_record
from noack.protocol.record_tables import OWNER
from noack.runtime.control_messages import RunProgress, parse_message
from noack.scenario.resolution import resolve, run_tables
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, load
from tests.cosim.live.outage import SCENARIOS, with_outage
from tests.fuzz.plane import FakePlane, Sample


@pytest.fixture(scope="module")
def run() -> RunRecord:
    """The controller stands still from 0.5 s to 0.7 s."""
    return with_outage(resolve(load(SCENARIOS / "lane_following.toml", ["horizon_s=1"])), 0.5, 0.7)


class RecordingPlane(FakePlane):
    """A control plane that stores the recorder's reports."""

    def __init__(self) -> None:
        super().__init__()
        self.reports: list[RunProgress] = []

    def publish(self, *parts: str, content: Any) -> None:
        assert parts == ("progress",)
        self.reports.append(parse_message(RunProgress, content))


def recorder_of(scenario: Scenario, run_dir: Path, plane: FakePlane) -> Recorder:
    (run_dir / SCENARIO_FILE).write_text(dumps(scenario))
    return Recorder(scenario, run_dir, plane)  # type: ignore[arg-type]


def send(plane: FakePlane, record: RunRecord, until_ns: int, sent: dict[str, int]) -> None:
    for table in record.tables:
        first = sent.get(table, 0)
        sent[table] = int(np.searchsorted(record[table]["now_ns"], until_ns))
        rows = record[table][first : sent[table]]
        if len(rows):
            header = json.dumps({"first": first, "rows": len(rows)}).encode()
            key = f"t/{OWNER[table]}/{table}"
            sent_rows = with_loop(rows, 0, run_tables(record.scenario)[table])
            plane.put("telemetry", Sample(key, sent_rows.tobytes(), header))


def recorded(recorder: Recorder, run_dir: Path) -> RunRecord:
    """The record after the end of the recorder."""
    recorder.finish()
    recorder.report()
    return finish_record(run_dir).loop()


def test_the_recorder_reports_a_violation_once_and_records_it(
    run: RunRecord, tmp_path: Path
) -> None:
    plane, sent = RecordingPlane(), {}  # type: ignore[var-annotated]
    recorder = recorder_of(run.scenario, tmp_path, plane)
    for until_ns in range(100_000_000, 1_200_000_000, 100_000_000):
        send(plane, run, until_ns, sent)
        recorder.poll()
        recorder.show()
    cause = "an input was 0.101 s old, 0.007 s allowed"
    line = (
        f"later than allowed from 0.506 s on: {cause}; there are certificates for up to 0.05502 s"
    )
    late = [report.warnings for report in plane.reports]
    assert late == [[]] * 5 + [[line]] * 6
    notices = recorded(recorder, tmp_path).notices
    assert notices == [{"t_ns": 506_000_000, "level": "late", "text": line, "process": "recorder"}]
    assert load_record(tmp_path).notices == notices


def test_the_summary_lists_every_violated_assumption(run: RunRecord) -> None:
    reported = summarise(run, 0, "horizon").assumption_violations
    assert reported == []  # no process detects that an input is old
    found = {one.cause: one for one in list_violations(reported, RunClaims(run).violations())}
    assert found.keys() == {"hold"}
    assert found["hold"].t_s == pytest.approx(0.506)
    assert found["hold"].what == "an input was 0.203 s old, 0.007 s allowed"
    assert found["hold"].process == "recorder"


def test_a_violation_found_at_the_end_is_reported(run: RunRecord, tmp_path: Path) -> None:
    plane = RecordingPlane()
    recorder = recorder_of(run.scenario, tmp_path, plane)
    send(plane, run, 1_200_000_000, {})
    recorder.poll()
    (notice,) = recorded(recorder, tmp_path).notices
    assert [report.warnings for report in plane.reports] == [[notice["text"]]]


def test_missing_rows_are_reported_as_an_unknown_result(run: RunRecord, tmp_path: Path) -> None:
    plane, sent = RecordingPlane(), {}  # type: ignore[var-annotated]
    recorder = recorder_of(run.scenario, tmp_path, plane)
    send(plane, run, 300_000_000, sent)
    sent["sensor_measurement"] += 10  # a batch is lost and sent again at the end
    send(plane, run, 1_200_000_000, sent)
    recorder.poll()
    recorder.show()
    recorder.show()
    assert plane.reports[-1].warnings == [
        "claims are checked after the run only: telemetry is missing or arrived out of order"
    ]
    assert recorded(recorder, tmp_path).notices == []


@pytest.mark.parametrize("terminal", [True, False])
def test_the_terminal_reports_each_cause_once(run: RunRecord, terminal: bool) -> None:
    shown = io.StringIO()
    report: dict[str, Any] = {
        "t_s": 0.5, "events": 3, "deliveries": 2, "longest_loss_burst": 1, "x_norm": 1.0,
        "live": None,
    }  # fmt: skip
    console = Console(file=shown, force_terminal=terminal, width=200)
    with progress_line(console, run.scenario) as watcher:
        watcher.started(Path())
        watcher.progress(RunProgress(**report))
        for void in ([], ["one [cause]"], ["one [cause]"], ["one [cause]", "another"]):
            watcher.progress(RunProgress(**report, warnings=void))
    assert shown.getvalue().count("one [cause]") == 1
    assert shown.getvalue().count("another") == 1


def test_nothing_is_reported_after_the_stop(run: RunRecord, tmp_path: Path) -> None:
    plane = RecordingPlane()
    recorder = recorder_of(run.scenario, tmp_path, plane)
    recorder.is_stopping = True
    send(plane, run, 1_200_000_000, {})
    recorder.poll()
    recorder.show()
    assert recorded(recorder, tmp_path).notices == []

"""The replay at the end of a run can cost neither the run's good end nor its summary."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import cosim.live.finalize
from cosim.live.finalize import finalize, reopen
from cosim.output.run_verdict import print_outcome
from cosim.record.environment import write_environment
from cosim.record.run_directory import ENDING_FILE, REPORTS_FILE, SCENARIO_FILE, SUMMARY_FILE
from cosim.record.run_ending import EndingFile, RunEnding
from cosim.record.run_record import RunRecord, write_record
from cosim.simulation.virtual_time import simulate
from noack.config.resolution import resolve
from noack.config.scenario_file import dumps, validate
from noack.core.errors import CallerError, ExitStatus
from noack.protocol.record_tables import PLANT_STEP


@pytest.fixture
def run_dir(content: dict[str, Any], tmp_path: Path) -> Path:
    """A run without a summary that says it was live, its record a simulated one's."""
    record = simulate(resolve(validate(content, "test")))
    (tmp_path / SCENARIO_FILE).write_text(dumps(record.scenario))
    write_environment(tmp_path, "live")
    reports = {role: report | {"realtime": {}} for role, report in record.reports.items()}
    (tmp_path / REPORTS_FILE).write_text(json.dumps(reports))
    write_record(record, tmp_path)
    return tmp_path


def summary_of(run_dir: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((run_dir / SUMMARY_FILE).read_text())
    return summary


def test_the_summary_holds_the_verdict(run_dir: Path) -> None:
    outcome = reopen(run_dir)
    verdict = outcome.summary["replay"]
    assert verdict["bit_exact"]
    assert verdict["complete"]
    assert verdict["inputs"] > 1000
    assert summary_of(run_dir) == outcome.summary


def test_a_difference_does_not_change_how_the_run_ended(run_dir: Path) -> None:
    unharmed = reopen(run_dir)
    (run_dir / SUMMARY_FILE).unlink()
    record = cosim.live.finalize.load_record(run_dir)
    record[PLANT_STEP]["u"][9, 0] = np.nan
    write_record(record, run_dir)
    harmed = reopen(run_dir)
    assert harmed.status == unharmed.status
    assert harmed.summary["replay"]["bit_exact"] is False
    first = summary_of(run_dir)["replay"]["first_difference"]
    assert (first["table"], first["row"], first["column"]) == (PLANT_STEP, 9, "u_1")


def test_a_replay_that_crashes_is_no_crash(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(record: object) -> None:
        raise RuntimeError("a mistake of ours")

    unharmed = reopen(run_dir)
    (run_dir / SUMMARY_FILE).unlink()
    monkeypatch.setattr(cosim.live.finalize, "replay", crash)
    outcome = reopen(run_dir)
    assert outcome.status == unharmed.status
    assert outcome.summary["replay"]["bit_exact"] is None
    assert "a mistake of ours" in summary_of(run_dir)["replay"]["error"]
    assert outcome.summary | {"replay": None} == unharmed.summary | {"replay": None}


def ended_well(run_dir: Path) -> RunEnding:
    return RunEnding(run_dir, 0, ExitStatus.OK, "horizon")


def test_a_run_that_cannot_be_replayed_fails(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert finalize(ended_well(run_dir), report=False).status == ExitStatus.OK

    def crash(record: object) -> None:
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr(cosim.live.finalize, "replay", crash)
    outcome = finalize(ended_well(run_dir), report=False)
    assert outcome.status == ExitStatus.FAILED
    assert outcome.reason == ("the run cannot be replayed: RuntimeError('a mistake of ours')")
    assert summary_of(run_dir)["exit"] == {"status": 1, "reason": outcome.reason}


def test_a_run_whose_record_is_lost_fails(run_dir: Path) -> None:
    record = cosim.live.finalize.load_record(run_dir)
    no_rows = {table: record[table][:0] for table in record.tables}
    write_record(RunRecord(record.scenario, no_rows, [], {}), run_dir)
    (run_dir / REPORTS_FILE).unlink()  # of how much there was, nobody knows
    outcome = finalize(ended_well(run_dir), report=False)
    assert outcome.status == ExitStatus.FAILED
    assert outcome.reason == "the run cannot be replayed: the record has no inputs"


@pytest.mark.parametrize("cut", [slice(-40, None), slice(100, 140), slice(0, None)])
def test_a_run_whose_rows_are_missing_fails(run_dir: Path, cut: slice) -> None:
    record = cosim.live.finalize.load_record(run_dir)
    rows = {table: record[table] for table in record.tables}
    lost = len(rows[PLANT_STEP][cut])
    rows[PLANT_STEP] = np.delete(rows[PLANT_STEP], cut)
    write_record(RunRecord(record.scenario, rows, [], record.reports), run_dir)
    with EndingFile(run_dir) as file:
        file.store(ExitStatus.OK, "horizon", 1.5)
    outcome = finalize(ended_well(run_dir), report=False)
    assert outcome.status == ExitStatus.FAILED
    stored = json.loads((run_dir / ENDING_FILE).read_text())
    assert stored["exit"] == {"status": 1, "reason": outcome.reason}
    assert outcome.reason == f"rows are missing from the record: {lost:,} of plant_step"
    stopped = RunEnding(run_dir, 0, ExitStatus.INTERRUPTED, "stopped by the user (SIGINT)")
    assert finalize(stopped, report=False).status == ExitStatus.INTERRUPTED


def test_an_interrupted_replay_leaves_a_summary(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(record: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cosim.live.finalize, "replay", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reopen(run_dir)
    assert summary_of(run_dir)["replay"] is None
    assert reopen(run_dir).summary["replay"] is None


@pytest.mark.parametrize(
    "lacking", ["assumptions", "kind", "lateness_us", "identity_residual_relative"]
)
def test_a_summary_of_an_earlier_version_is_made_whole(run_dir: Path, lacking: str) -> None:
    """How the run ended is kept: that is all that the record does not know."""
    whole = reopen(run_dir)
    ended = {"exit": {"status": 143, "reason": "stopped by SIGTERM"}}
    earlier = {k: v for k, v in whole.summary.items() if k != lacking} | ended
    (run_dir / SUMMARY_FILE).write_text(json.dumps(earlier))
    outcome = reopen(run_dir)
    assert outcome.summary == whole.summary | ended
    assert (outcome.status, outcome.reason) == (143, "stopped by SIGTERM")


@pytest.mark.parametrize("end", [None, {}, {"status": 99, "reason": ""}])
def test_a_summary_that_does_not_know_the_end_is_written_anew(run_dir: Path, end: Any) -> None:
    whole = reopen(run_dir)
    (run_dir / SUMMARY_FILE).write_text(json.dumps(whole.summary | {"exit": end}))
    assert reopen(run_dir).summary == whole.summary


def test_what_the_launcher_stored_is_how_the_run_ended(run_dir: Path) -> None:
    """A blank file is of a launcher that ended before the run."""
    with EndingFile(run_dir) as file:
        assert (reopen(run_dir).status, reopen(run_dir).reason) == (1, "the launcher ended early")
        (run_dir / SUMMARY_FILE).unlink()
        file.store(ExitStatus.FAILED, "x" * 10_000)
        file.store(ExitStatus.TERMINATED, "stopped by SIGTERM", 1.5)
    outcome = reopen(run_dir)
    assert (outcome.status, outcome.reason) == (143, "stopped by SIGTERM")
    assert outcome.summary["startup_s"] == 1.5
    (run_dir / SUMMARY_FILE).write_text("damaged")
    assert reopen(run_dir).reason == "stopped by SIGTERM"


def test_an_error_of_the_launcher_is_stored_as_the_end(run_dir: Path) -> None:
    with pytest.raises(CallerError), EndingFile(run_dir):
        raise CallerError("the port is taken")
    outcome = reopen(run_dir)
    assert (outcome.status, outcome.reason) == (2, "the port is taken")


@pytest.mark.parametrize("new", ["claims", "conditions", "fidelity", "replay"])
def test_what_is_new_in_a_summary_may_be_lacking(run_dir: Path, new: str) -> None:
    whole = reopen(run_dir)
    earlier = {k: v for k, v in whole.summary.items() if k != new}
    (run_dir / SUMMARY_FILE).write_text(json.dumps(earlier))
    outcome = reopen(run_dir)
    assert outcome.summary == earlier
    print_outcome(Console(quiet=True), outcome)


def test_a_damaged_log_is_one_clear_line(run_dir: Path) -> None:
    (run_dir / "record/notices.jsonl").write_bytes(b"\xae\xff")
    with pytest.raises(CallerError, match=r"notices\.jsonl: cannot be read"):
        reopen(run_dir)

"""The end of a run: its summary, and how faults of record and analysis change it."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn
from unittest.mock import patch

import numpy as np
import pytest

import cosim.live.finalize
from cosim.analysis.claims.run_certificates import RunCertificate, expected_certificates
from cosim.analysis.summary.summary_model import RunSummary
from cosim.live.finalize import finalize, reopen
from cosim.live.processes.early_certificates import LaunchedEnding
from cosim.live.processes.process_pool import process_starts, processes
from cosim.record.record_writing import write_run
from cosim.record.run_directory import (
    ENDING_FILE,
    RECORDING_FILE,
    REPORTS_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    EndingFile,
    RunEnding,
    write_environment,
)
from cosim.record.run_record import load_record, load_run
from cosim.record.spool_conversion import finish_record
from cosim.simulation.virtual_time import simulate, simulate_run
from netem.core.errors import CallerError, ExitStatus, MachineError
from noack.protocol.record_tables import PLANT_STEP
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps
from tests.cosim.record.changed_records import changed
from tests.helpers.shipped import resolved, shipped
from tests.helpers.summaries import run_of_one_loop

pytestmark = pytest.mark.usefixtures("no_report")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that is marked as live, with the record of a simulated one and without a summary."""
    folder = tmp_path_factory.mktemp("recorded")
    record = simulate(resolved("double_integrator", "horizon_s=1"))
    (folder / SCENARIO_FILE).write_text(dumps(record.scenario))
    write_environment(folder, "live")
    reports = {role: report | {"realtime": {}} for role, report in record.reports.items()}
    (folder / REPORTS_FILE).write_text(json.dumps(reports))
    write_run(run_of_one_loop(record), folder)
    return folder


@pytest.fixture
def run_dir(recorded: Path, tmp_path: Path) -> Path:
    """A copy of the run."""
    return Path(shutil.copytree(recorded, tmp_path / "run"))


def summary_of(run_dir: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((run_dir / SUMMARY_FILE).read_text())
    return summary


def test_a_difference_in_the_replay_does_not_fail_the_run(run_dir: Path) -> None:
    record = load_record(run_dir)
    record[PLANT_STEP]["u"][9, 0] = np.nan
    write_run(run_of_one_loop(record), run_dir)
    outcome = finalize(ended_well(run_dir), report=False, view=False)
    assert outcome.status == ExitStatus.OK
    assert outcome.summary.to_json() == summary_of(run_dir)
    first = summary_of(run_dir)["loops"][0]["replay"]["first_difference"]
    assert (first["table"], first["row"], first["column"]) == (PLANT_STEP, 9, "u_1")


def ended_well(run_dir: Path) -> RunEnding:
    return RunEnding(run_dir, 0, ExitStatus.OK, "horizon")


def no_rows(run_dir: Path) -> None:
    record = load_record(run_dir)
    empty = {table: record[table][:0] for table in record.tables}
    write_run(run_of_one_loop(changed(record, empty, reports={})), run_dir)
    (run_dir / REPORTS_FILE).unlink()  # the total number of rows is unknown


def missing_rows(run_dir: Path, cut: slice) -> None:
    record = load_record(run_dir)
    write_run(run_of_one_loop(changed(record, {PLANT_STEP: np.delete(record[PLANT_STEP], cut)})), run_dir)


def more_rows(run_dir: Path) -> None:
    reports = json.loads((run_dir / REPORTS_FILE).read_text())
    reports["plant"]["rows_by_loop"][PLANT_STEP][0] -= 7
    (run_dir / REPORTS_FILE).write_text(json.dumps(reports))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (no_rows, "the run cannot be replayed: the record has no inputs"),
        (
            lambda run_dir: missing_rows(run_dir, slice(-40, None)),
            "rows are missing from the record: 40 of plant_step",
        ),
        (
            lambda run_dir: missing_rows(run_dir, slice(100, 140)),
            "rows are missing from the record: 40 of plant_step",
        ),
        (more_rows, "the record has more rows than the processes reported: 7 of plant_step"),
    ],
)
def test_a_run_whose_record_is_not_complete_fails(
    run_dir: Path, damage: Callable[[Path], None], reason: str
) -> None:
    damage(run_dir)
    with EndingFile(run_dir) as file:
        file.store(ExitStatus.OK, "horizon", 1.5)
    outcome = finalize(ended_well(run_dir), report=False, view=False)
    assert (outcome.status, outcome.reason) == (ExitStatus.FAILED, reason)
    assert summary_of(run_dir)["exit"] == {"status": 1, "reason": reason}
    stored = json.loads((run_dir / ENDING_FILE).read_text())
    assert stored["exit"] == {"status": 0, "reason": "horizon"}  # the launcher saw no fault
    stopped = RunEnding(run_dir, 0, ExitStatus.INTERRUPTED, "stopped by the user (SIGINT)")
    assert finalize(stopped, report=False, view=False).status == ExitStatus.INTERRUPTED


def test_a_run_that_cannot_be_replayed_or_whose_directory_is_deleted_fails(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A directory that is gone is not created again."""

    def crash(*_: object) -> NoReturn:
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr(cosim.live.finalize, "replay", crash)
    outcome = finalize(ended_well(run_dir), report=False, view=False)
    assert outcome.status == ExitStatus.FAILED
    assert outcome.reason == "the run cannot be replayed: RuntimeError('a mistake of ours')"
    monkeypatch.setattr(cosim.live.finalize, "replay", lambda *_: shutil.rmtree(run_dir))
    with pytest.raises(MachineError, match=r"summary\.json: cannot be written: No such file"):
        finalize(ended_well(run_dir), report=False)
    assert not run_dir.exists()
    run_dir.mkdir()  # it was replaced
    with pytest.raises(
        MachineError,
        match=r"^the run failed: it was moved\n.*: no such file; the run directory was deleted or replaced$",
    ):
        finalize(RunEnding(run_dir, 1, ExitStatus.FAILED, "it was moved", None))


def test_an_interrupted_replay_leaves_a_summary(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cosim.live.finalize, "replay", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reopen(run_dir, view=False)
    assert summary_of(run_dir)["loops"][0]["replay"] is None
    assert reopen(run_dir, view=False).summary.loops[0].replay is None


@pytest.mark.usefixtures("no_recording")
def test_the_stored_ending_is_used_without_a_summary(run_dir: Path) -> None:
    """An empty file comes from a launcher that ended before the run."""
    with EndingFile(run_dir) as file:
        outcome = reopen(run_dir)
        assert (outcome.status, outcome.reason) == (1, "the launcher ended early")
        (run_dir / SUMMARY_FILE).unlink()
        file.store(ExitStatus.FAILED, "x" * 10_000)
        file.store(ExitStatus.TERMINATED, "stopped by SIGTERM", 1.5)
    outcome = reopen(run_dir)
    assert (outcome.status, outcome.reason) == (143, "stopped by SIGTERM")
    assert outcome.summary.startup_s == 1.5
    (run_dir / SUMMARY_FILE).write_text("damaged")
    assert reopen(run_dir).reason == "stopped by SIGTERM"
    with pytest.raises(CallerError), EndingFile(run_dir):
        raise CallerError("the port is taken")
    (run_dir / SUMMARY_FILE).unlink()
    outcome = reopen(run_dir)
    assert (outcome.status, outcome.reason) == (2, "the port is taken")


def test_an_interrupted_finalisation_is_completed(run_dir: Path) -> None:
    """It may have ended while the log, the spool or the viewer's recording was written."""
    finalize(ended_well(run_dir), report=False)
    notices, write = run_dir / "record/notices.jsonl", json.dumps
    notices.write_text('{"t_ns": 5, "level": "info", "text": "kept", "process": "plant"}\n')
    old_text = notices.read_text()
    for name in (SPOOL, f"{SPOOL}.done"):
        writer = SpoolWriter(run_dir / name, "plant")
        writer.append(PLANT_STEP, 0, b"")
        writer.close()

    def full(value: Any, **options: Any) -> str:
        if isinstance(value, dict) and not options:
            raise OSError(28, "No space left on device")
        return write(value, **options)

    with patch("json.dumps", full), pytest.raises(MachineError, match="No space"):
        finish_record(run_dir)
    assert notices.read_text() == old_text
    assert finish_record(run_dir).loop().notices
    assert not [*run_dir.glob(f"{SPOOL}*")]
    (run_dir / SUMMARY_FILE).unlink()
    (run_dir / RECORDING_FILE).write_bytes(b"cut")
    reopen(run_dir)
    assert (run_dir / RECORDING_FILE).stat().st_size > 10_000


# --- other processes ------------------------------------------------------------------------------


JudgedRun = tuple[Path, RunSummary]
LOOPS = 3


@pytest.fixture(scope="module")
def judged_alone(tmp_path_factory: pytest.TempPathFactory) -> JudgedRun:
    """A run of several loops, and its summary by one process."""
    scenario = shipped("shared_bottleneck", "horizon_s=0.2", "certificate.prove=false")
    assert scenario.loops is not None
    loops = (scenario.loops[0].model_copy(update={"count": LOOPS}),)
    folder = tmp_path_factory.mktemp("many")
    run_dir = simulate_run(scenario.model_copy(update={"loops": loops}), folder).run_dir
    summary = finalize(ended_well(run_dir), report=False, view=False).summary
    (run_dir / SUMMARY_FILE).unlink()
    return run_dir, summary


@pytest.fixture
def many_loops(
    judged_alone: tuple[Path, RunSummary], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A copy of the run, whose loops are evaluated by other processes."""
    monkeypatch.setattr(cosim.live.finalize, "_MANY_STEPS", 10)
    monkeypatch.setattr(cosim.live.finalize, "_LEAST_LOOPS", LOOPS - 1)  # two blocks
    monkeypatch.setattr(cosim.live.finalize, "cores", lambda: 2)
    run_dir, _ = judged_alone
    return Path(shutil.copytree(run_dir, tmp_path / run_dir.name))


@pytest.mark.parametrize("is_killed", [False, True])
def test_other_processes_find_the_same_even_if_one_is_killed(
    judged_alone: tuple[Path, RunSummary],
    many_loops: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    is_killed: bool,
) -> None:
    @contextmanager
    def killed(workers: int) -> Iterator[ProcessPoolExecutor]:
        with processes(workers) as pool:
            with process_starts():
                killing = pool.submit(os._exit, 1)
            with pytest.raises(BrokenProcessPool):
                killing.result()
            yield pool

    if is_killed:
        monkeypatch.setattr(cosim.live.finalize, "processes", killed)
    _, expected = judged_alone
    assert finalize(ended_well(many_loops), report=False, view=not is_killed).summary == expected


def test_certificates_that_are_known_at_the_end_are_used(
    judged_alone: tuple[Path, RunSummary], many_loops: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of other loops are computed; here no other process is asked."""
    run = load_run(many_loops)
    known = {
        record.number: expected_certificates(record.scenario, len(run.names))
        for record in run.loops
        if record.number != 1
    }
    computed = []

    def recorded(scenario: Scenario, loops: int) -> list[RunCertificate] | None:
        computed.append(scenario.name)
        return expected_certificates(scenario, loops)

    monkeypatch.setattr(cosim.live.finalize, "cores", lambda: 1)
    monkeypatch.setattr(cosim.live.finalize, "expected_certificates", recorded)
    ending = LaunchedEnding(many_loops, 0, ExitStatus.OK, "horizon", certificates=known)
    _, expected = judged_alone
    assert finalize(ending, report=False, view=False).summary == expected
    assert computed == [run.names[1]]

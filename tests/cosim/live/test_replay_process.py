"""A long run is replayed in a process of its own; the result is that of a replay in this one."""

import json
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

import cosim.live.finalize
import cosim.live.replay_process
from cosim.analysis.replay import replay
from cosim.live.finalize import finalize
from cosim.live.replay_process import ReplayProcess
from cosim.record.run_directory import SUMMARY_FILE, RunEnding, write_environment, write_scenario
from cosim.record.run_record import load_record, write_run
from cosim.shipped_files import find_shipped
from cosim.simulation.virtual_time import simulate
from noack.config.resolution import resolve
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus
from noack.protocol.record_tables import PLANT_STEP
from tests.cosim.summaries import alone
from tests.integration.conftest import wait_for


@pytest.fixture
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    scenario = find_shipped("double_integrator", "scenarios")
    record = simulate(resolve(load(scenario, ["horizon_s=1"])))
    record[PLANT_STEP]["u"][9, 0] += 1.0
    write_scenario(record.scenario, tmp_path)
    write_environment(tmp_path, "live")
    write_run(alone(record), tmp_path)
    monkeypatch.setattr(cosim.live.replay_process, "_LEAST_STEPS", 10)
    return tmp_path


def test_the_result_is_that_of_a_replay_in_this_process(run_dir: Path) -> None:
    record = load_record(run_dir)
    with ReplayProcess(record, run_dir) as process:
        found = process.verdict()
    assert found == replay(record).verdict()
    assert found is not None
    assert found["first_difference"]["row"] == 9


def test_the_replay_of_a_run_is_not_lost_with_its_process(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(ReplayProcess):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments)  # type: ignore[arg-type]
            assert self._process is not None
            self._process.kill()

    monkeypatch.setattr(cosim.live.finalize, "ReplayProcess", Killed)
    finalize(RunEnding(run_dir, 0, ExitStatus.OK, "horizon"), report=False)
    found = json.loads((run_dir / SUMMARY_FILE).read_text())["loops"][0]["replay"]
    assert found["first_difference"]["row"] == 9


def test_a_machine_that_starts_no_processes_replays_in_this_one(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    with ReplayProcess(load_record(run_dir), run_dir) as process:
        assert process.verdict() is None


@pytest.mark.skipif(sys.platform == "win32", reason="kills as POSIX does")
def test_the_process_ends_with_its_parent(run_dir: Path) -> None:
    code = f"""
import time
from pathlib import Path
from cosim.live import replay_process
from cosim.record.run_record import load_record
replay_process._LEAST_STEPS = 10
process = replay_process.ReplayProcess(load_record(Path({str(run_dir)!r})), Path({str(run_dir)!r}))
print(process._process.pid, flush=True)
time.sleep(1000)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        parent.kill()
    wait_for(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)

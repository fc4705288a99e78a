"""A live run of the page: what it reports, what it writes, how it ends."""

import asyncio
import json
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from cosim.interactive.scenario_draft import open_draft
from cosim.lab import live_run
from cosim.lab.live_run import LiveRun
from cosim.lab.recorded_views import live_view
from cosim.record.run_directory import SCENARIO_FILE
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.runtime.spool import SPOOL, SpoolWriter
from noack.scenario.scenario_file import dumps
from tests.helpers.live_runs import WITHOUT_VIEWER
from tests.helpers.rows_of_loops import mixed_rows
from tests.helpers.shipped import resolved
from tests.helpers.summaries import run_of_one_loop


def report_event(run: LiveRun, event: str, **fields: object) -> None:
    run._handle_line(json.dumps({"event": event, **fields}))


REPORT = {
    "t_s": 1.5, "events": 3, "deliveries": 2, "longest_loss_burst": 1, "x_norm": 0.5,
    "live": None, "warnings": [], "changes": [],
}  # fmt: skip


def test_what_a_live_run_reports_sets_its_state_and_its_lines() -> None:
    run = LiveRun(20.0)
    assert run.state == "starting"
    report_event(run, "started", run_dir="/runs/one")
    assert (run.state, run.run_dir) == ("running", Path("/runs/one"))
    live = "live view: http://127.0.0.1:1234/secret/"
    for changes in ([], ["M 3"]):  # each warning is shown once
        report_event(run, "progress", **REPORT | {"warnings": ["void"], "changes": changes, "live": live})
    assert run.lines == ["all processes run", "void", "changed: M 3"]
    assert run.viewer == "http://127.0.0.1:1234/secret/"
    report_event(run, "finalising", reason="horizon")
    assert run.state == "finalising"
    assert not run.is_over
    lines = [["completed 20 s", "good"], ["3 transmissions, 2 delivered", ""]]
    report_event(run, "ended", run_dir="/runs/one", reason="horizon", ok=True, verdict=lines)
    assert run.is_over
    assert run.ok
    assert run.progress is not None
    assert run.progress.events == 3
    assert run.verdict == [("completed 20 s", "good"), ("3 transmissions, 2 delivered", "")]
    failed = LiveRun(20.0)
    report_event(failed, "error", text="the port is taken")
    assert failed.is_over
    assert failed.ok is False
    assert failed.lines == ["the port is taken"]


@pytest.mark.parametrize("line", ["", "compiling ...", "{", "[1]", '{"x": 1}', "7"])
def test_other_output_is_a_line_of_the_log(line: str) -> None:
    run = LiveRun(20.0)
    run._handle_line(line)
    assert run.lines == [line] * bool(line)
    assert run.state == "starting"


def test_a_run_writes_nothing_beside_the_scenario_and_reads_the_files_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user may replace what is written there, or place links before."""
    folder, private = tmp_path / "shared", tmp_path / "private"
    folder.mkdir()
    private.write_text("precious")
    draft = open_draft("saturated_lqr").with_value("horizon_s", 0.5)
    shutil.copy(draft.folder / "saturated_lqr.py", folder)
    (folder / f".lab-{os.getpid()}.toml").symlink_to(private)
    monkeypatch.setenv("PYTHONPATH", WITHOUT_VIEWER["PYTHONPATH"])
    changed_ns = folder.stat().st_mtime_ns  # changes if a file is made, renamed or removed

    async def run() -> LiveRun:
        live = LiveRun(0.5)
        await live.start(draft.text, folder, tmp_path / "runs")
        await live.follow()
        return live

    live = asyncio.run(run())
    assert live.state == "ended", live.lines
    assert folder.stat().st_mtime_ns == changed_ns
    assert private.read_text() == "precious"


STUBBORN = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize(("state", "status"), [("running", -signal.SIGKILL), ("finalising", 0)])
def test_a_loop_that_does_not_end_is_killed_but_not_its_check(
    state: str, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_run, "_STOP_S", 0.0)

    async def end() -> int | None:
        run = LiveRun(20.0)
        run._process = process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", STUBBORN, stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        await process.stdout.readline()
        run.state = state
        if state == "finalising":
            asyncio.get_running_loop().call_later(0.2, process.stdin.close)
        await run.end()
        return process.returncode

    assert asyncio.run(end()) == status


def test_a_run_without_a_recorded_measurement_is_not_drawn_yet(tmp_path: Path) -> None:
    """On a busy machine the controller's rows may come first."""
    record = simulate(resolved("double_integrator", "horizon_s=0.1"))
    rows = mixed_rows(run_of_one_loop(record))
    (tmp_path / SCENARIO_FILE).write_text(dumps(record.scenario))
    writer = SpoolWriter(tmp_path / SPOOL, "recorder")
    for table in (CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT):
        assert live_view(tmp_path) is None
        writer.append(table, 0, rows[table].tobytes())
    assert live_view(tmp_path) is not None
    writer.close()

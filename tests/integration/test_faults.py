"""Faults of processes and ports: the run names them, ends cleanly and loses no rows."""

import re
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from cosim.cli import app
from cosim.live.finalize import reopen
from cosim.record.run_record import load_record
from tests.integration import conftest as live

Start = Callable[..., live.Running]
LONG = [*live.AT_RATE, *live.settings(speed=4.0, horizon_s=400.0)]


def test_a_killed_recorder_is_named_and_no_recorded_row_is_lost(start: Start) -> None:
    reason = "recorder died: killed by SIGKILL"
    running = start(*LONG, "--report")
    running.wait_recording()
    running.child("recorder").send_signal(signal.SIGKILL)
    finished = running.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == reason
    assert f"{reason}; the run ends, and its record is completed\n" in finished.stderr
    record = load_record(finished.run_dir)
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        assert len(rows) > 10
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    live.assert_complete(finished.loop)  # the others kept their final reports
    assert (finished.run_dir / "recording.rrd").stat().st_size > 0
    assert reason in (finished.run_dir / "report.html").read_text()
    assert not (finished.run_dir / "spool").exists()
    assert running.left_behind() == []


def test_a_frozen_recorder_is_named_and_no_row_is_lost(start: Start) -> None:
    """The run ends because it has no recorder; the other processes store their rows themselves."""
    running = start(*LONG, impatient=True)
    running.wait_recording()
    running.child("recorder").send_signal(signal.SIGSTOP)
    finished = running.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "recorder stopped responding"
    live.assert_complete(finished.loop)
    steps = load_record(finished.run_dir)["plant_step"]
    # Rows exist up to the end of the lease: two seconds since the last keep-alive.
    assert len(steps) > 1.5 * 4 * live.RATE_HZ
    assert np.array_equal(steps["sequence"], np.arange(len(steps)))
    assert not (finished.run_dir / "spool").exists()
    assert live.private_files(running.runs.parent) == []
    assert running.left_behind() == []


def test_a_killed_launcher_leaves_no_process_behind(start: Start) -> None:
    running = start(*LONG)
    running.wait_recording()
    running.process.kill()
    assert running.left_behind() == []
    run_dir = (running.runs / "latest").resolve()
    assert reopen(run_dir).reason == "the launcher ended early"
    assert len(load_record(run_dir)["plant_step"]) > 10


def test_what_a_late_plant_sends_after_the_horizon_is_received(tmp_path: Path) -> None:
    """It is stopped before the horizon and goes on half a second after it."""
    for attempt in range(10):  # a machine that stalls may stop it after its end, or go on too late
        (folder := tmp_path / str(attempt)).mkdir()
        with live.begun(folder) as start:
            running = start(*live.AT_RATE, *live.settings(horizon_s=3.0))
            running.wait_recording()
            plant = running.child("plant")
            plant.send_signal(signal.SIGSTOP)
            time.sleep(2.8)
            plant.send_signal(signal.SIGCONT)
            finished = running.finish()
        lost = finished.loop["unintended_losses"] + finished.loop["missing_samples"]
        steps = load_record(finished.run_dir)["plant_step"]
        was_late = (steps["now_ns"] - steps["t_ns"]).max() > 1e9
        if was_late and not lost and finished.status == 0:
            break
    assert was_late
    assert lost == 0
    assert finished.status == 0


def test_a_taken_port_gives_one_clear_line(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as squatter:
        squatter.bind(("127.0.0.1", 0))
        port = squatter.getsockname()[1]
        given = (*live.EPHEMERAL, *live.settings(ports__plant=port))
        done = CliRunner().invoke(app, ["run", "lane_following", "--runs", str(tmp_path), *given])
    assert done.exit_code == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert f"127.0.0.1:{port} " in line
    assert "set ports.plant to another port, or to 0 for any" in line


def test_an_overloaded_run_does_not_claim_its_horizon(tmp_path: Path) -> None:
    """The plant needs five times the time that it has."""
    code = tmp_path / "slow.py"
    code.write_text(
        "import time\n"
        "class Slow:\n"
        "    def start(self, x0): self.x = x0\n"
        "    def advance(self, u, t_s, dt_s): time.sleep(5 * dt_s)\n"
    )
    finished = live.run_scenario(
        tmp_path,
        "--set", f'plant.system={{kind="python", file="{code}", name="Slow"}}',
        *live.settings(horizon_s=2.0, plant__draw="nominal"),
    )  # fmt: skip
    assert finished.status == 1
    # Its other threads may starve, too; the process then seems to be lost.
    reason = finished.summary["exit"]["reason"]
    assert "overrun" in reason or "stopped responding" in reason
    assert finished.summary["reached_s"] < 2.0


def test_a_process_that_is_not_ready_in_time_is_named(start: Start) -> None:
    """It is frozen before the start barrier, so that it has no liveliness token."""
    running = start(*LONG, *live.settings(start_within_s=2.0), impatient=True)
    live.wait_for(lambda: live.child_of(running.process, "sensor") is not None)
    sensor = live.child_of(running.process, "sensor")
    assert sensor is not None
    sensor.send_signal(signal.SIGSTOP)
    error = running.finish_unstarted()
    # On a busy machine, other processes may not be ready, either.
    reason = re.search(r"sensor\b.* not ready in time: waited \d+ s.* cores", error)
    assert reason is not None, error
    assert not sensor.is_running()
    (run_dir,) = running.runs.glob("*-lane_following")
    outcome = reopen(run_dir)
    assert outcome.status == 1
    assert error.startswith(f"{outcome.reason} (logs in ")

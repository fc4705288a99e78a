"""Faults of processes and ports: the run names them, ends cleanly and loses no rows."""

import re
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.cli import app
from cosim.live.finalize import reopen
from cosim.record.run_record import load_record
from tests.integration import conftest as live

Start = Callable[..., live.Running]
LONG = [*live.AT_RATE, *live.settings(speed=4.0, horizon_s=400.0)]


def wait_recording(running: live.Running) -> None:
    """Wait until the recorder has stored rows of plant, sensor and controller."""
    running.wait_started()
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        spooled = running.runs / "latest" / "spool" / f"{table}.recorder"
        live.wait_for(lambda spooled=spooled: spooled.exists() and spooled.stat().st_size > 10_000)


def test_a_killed_recorder_is_named_and_no_recorded_row_is_lost(start: Start) -> None:
    reason = "recorder died: killed by SIGKILL"
    running = start(*LONG, "--report")
    wait_recording(running)
    running.child("recorder").send_signal(signal.SIGKILL)
    finished = running.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == reason
    record = load_record(finished.run_dir)
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        assert len(rows) > 10
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["replay"]["bit_exact"]
    assert not finished.summary["replay"]["complete"]  # a killed process cannot report its rows
    assert (finished.run_dir / "recording.rrd").stat().st_size > 0
    assert reason in (finished.run_dir / "report.html").read_text()
    assert not (finished.run_dir / "spool").exists()
    assert running.left_behind() == []


def test_a_frozen_recorder_is_named_and_no_row_is_lost(start: Start) -> None:
    """The run ends because it has no recorder; the other processes store their rows themselves."""
    running = start(*LONG)
    wait_recording(running)
    running.child("recorder").send_signal(signal.SIGSTOP)
    finished = running.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "recorder stopped responding"
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["unintended_losses"] == 0
    assert finished.summary["replay"]["bit_exact"]
    steps = load_record(finished.run_dir)["plant_step"]
    # Rows exist up to the end of the lease: two seconds since the last keep-alive.
    assert len(steps) > 1.5 * 4 * live.RATE_HZ
    assert np.array_equal(steps["sequence"], np.arange(len(steps)))
    assert not (finished.run_dir / "spool").exists()
    assert live.private_files(running.runs.parent) == []
    assert running.left_behind() == []


def test_a_killed_launcher_leaves_no_process_behind(start: Start) -> None:
    running = start(*LONG)
    wait_recording(running)
    running.process.kill()
    assert running.left_behind() == []
    run_dir = (running.runs / "latest").resolve()
    assert reopen(run_dir).reason == "the launcher ended early"
    assert len(load_record(run_dir)["plant_step"]) > 10


@pytest.mark.parametrize("role", ["plant", "control"])
def test_a_taken_port_gives_one_clear_line(tmp_path: Path, role: str) -> None:
    kind = socket.SOCK_STREAM if role == "control" else socket.SOCK_DGRAM
    with socket.socket(socket.AF_INET, kind) as squatter:
        squatter.bind(("127.0.0.1", 0))
        if role == "control":
            squatter.listen()
        port = squatter.getsockname()[1]
        given = (*live.EPHEMERAL, *live.settings(**{f"ports__{role}": port}))
        done = CliRunner().invoke(app, ["run", "lane_following", "--runs", str(tmp_path), *given])
    assert done.exit_code == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert f"127.0.0.1:{port} " in line
    assert f"set ports.{role} to another port, or to 0 for any" in line


def test_an_overloaded_run_does_not_claim_its_horizon(tmp_path: Path) -> None:
    finished = live.run_scenario(
        tmp_path,
        *live.settings(
            speed=1000.0, horizon_s=400.0, plant__rate_hz=10_000.0, plant__measure_every=2000
        ),
    )
    assert finished.status == 1
    # Its other threads may starve, too; the process then seems to be lost.
    reason = finished.summary["exit"]["reason"]
    assert "overrun" in reason or "stopped responding" in reason
    assert finished.summary["reached_s"] < 400.0


def test_a_process_that_is_not_ready_in_time_is_named(start: Start) -> None:
    """It is frozen before the start barrier, so that it has no liveliness token."""
    running = start(*LONG, *live.settings(start_within_s=2.0))
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

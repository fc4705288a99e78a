"""Faults of processes and ports: the run names them, ends cleanly and loses no rows."""

import re
import signal
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cosim.live.finalize import reopen
from cosim.record.run_record import load_record
from tests.integration.conftest import (
    AT_RATE,
    EPHEMERAL,
    PATIENCE_S,
    Running,
    child_of,
    noack_command,
    run_scenario,
    settings,
    wait_for,
)

Start = Callable[..., Running]
LONG = [*AT_RATE, *settings(speed=4.0, horizon_s=400.0)]


def wait_recording(running: Running) -> None:
    """Wait until the recorder has stored rows of plant, sensor and controller."""
    running.wait_started()
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        spooled = running.runs / "latest" / "spool" / f"{table}.recorder"
        wait_for(lambda spooled=spooled: spooled.exists() and spooled.stat().st_size > 10_000)


def test_a_killed_recorder_is_named_and_no_recorded_row_is_lost(start: Start) -> None:
    role = "recorder"
    running = start(*LONG, "--report")
    wait_recording(running)
    running.child(role).send_signal(signal.SIGKILL)
    finished = running.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == f"{role} died: killed by SIGKILL"
    record = load_record(finished.run_dir)
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        assert len(rows) > 10
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["replay"]["bit_exact"]
    assert not finished.summary["replay"]["complete"]  # a killed process cannot report its rows
    assert (finished.run_dir / "recording.rrd").stat().st_size > 0
    assert f"{role} died: killed by SIGKILL" in (finished.run_dir / "report.html").read_text()
    assert not (finished.run_dir / "spool").exists()
    assert running.left_behind() == []


def test_a_signal_ends_a_run_cleanly_and_summary_does_not_change_an_active_run(
    start: Start,
) -> None:
    running = start(*LONG)
    wait_recording(running)
    done = subprocess.run(
        noack_command("summary", str(running.runs / "latest")),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "still under way" in done.stderr
    running.process.send_signal(signal.SIGTERM)
    finished = running.finish()
    assert finished.status == 143
    assert finished.summary["exit"]["reason"] == "stopped on request (SIGTERM)"
    until_s = finished.summary["judged_until_s"]
    assert 0 < until_s <= finished.summary["reached_s"] + 0.1
    assert all((claim["since_s"] or 0.0) <= until_s for claim in finished.summary["claims"])
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["unintended_losses"] == 0
    assert set(finished.summary["realtime"]) == {"plant", "sensor", "controller", "netem"}
    assert running.left_behind() == []


def test_a_killed_launcher_leaves_no_process_behind(start: Start) -> None:
    running = start(*LONG)
    wait_recording(running)
    running.process.kill()
    assert running.left_behind() == []
    run_dir = (running.runs / "latest").resolve()
    done = subprocess.run(
        noack_command("summary", str(run_dir), "--json"), capture_output=True, text=True, check=True
    )
    assert '"events"' in done.stdout
    assert len(load_record(run_dir)["plant_step"]) > 10


@pytest.mark.parametrize("role", ["plant", "control"])
def test_a_taken_port_gives_one_clear_line(tmp_path: Path, role: str) -> None:
    kind = socket.SOCK_STREAM if role == "control" else socket.SOCK_DGRAM
    with socket.socket(socket.AF_INET, kind) as squatter:
        squatter.bind(("127.0.0.1", 0))
        if role == "control":
            squatter.listen()
        port = squatter.getsockname()[1]
        done = subprocess.run(
            noack_command(
                "run", "lane_following", "--runs", str(tmp_path), *EPHEMERAL,
                *settings(**{f"ports__{role}": port}),
            ),
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert f"127.0.0.1:{port} " in line
    assert f"set ports.{role} to another port, or to 0 for any" in line


def test_an_overloaded_run_does_not_claim_its_horizon(tmp_path: Path) -> None:
    finished = run_scenario(
        tmp_path,
        *settings(speed=1000.0, horizon_s=2000.0, plant__rate_hz=500.0, plant__measure_every=100),
    )
    assert finished.status == 1
    # Its other threads may starve, too; the process then seems to be lost.
    reason = finished.summary["exit"]["reason"]
    assert "overrun" in reason or "stopped responding" in reason
    assert finished.summary["reached_s"] < 2000.0


def test_a_process_that_is_not_ready_in_time_is_named(start: Start) -> None:
    """It is frozen before the start barrier, so that it has no liveliness token."""
    running = start(*LONG, *settings(start_within_s=5.0))
    wait_for(lambda: child_of(running.process, "sensor") is not None)
    sensor = child_of(running.process, "sensor")
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

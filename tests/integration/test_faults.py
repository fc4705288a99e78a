"""What kills a process, a port or a person's patience: named, ended cleanly, nothing lost."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest

from cosim.record import load_record
from noack.io.spool import SpoolWriter
from tests.integration.conftest import (
    EPHEMERAL,
    ROLE_MODULES,
    Running,
    noack_command,
    run_scenario,
    settings,
    wait_for,
)

Start = Callable[..., Running]
LONG = settings(speed=4.0, horizon_s=400.0)


def wait_recording(running: Running) -> None:
    """Wait until the recorder has something of everyone who has something to tell all the time."""
    running.wait_started()
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        spooled = running.runs / "latest" / "spool" / f"{table}.recorder"
        wait_for(lambda spooled=spooled: spooled.exists() and spooled.stat().st_size > 10_000)


@pytest.mark.parametrize("role", ROLE_MODULES)
def test_a_killed_process_is_named_and_nothing_recorded_is_lost(start: Start, role: str) -> None:
    running = start(*LONG)
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
    assert not finished.summary["replay"]["complete"]  # who was killed cannot say what is missing
    assert (finished.run_dir / "recording.rrd").stat().st_size > 0
    assert f"{role} died: killed by SIGKILL" in (finished.run_dir / "report.html").read_text()
    assert not (finished.run_dir / "spool").exists()
    assert running.left_behind() == []


def test_a_frozen_process_is_named(start: Start) -> None:
    running = start(*LONG)
    wait_recording(running)
    running.child("sensor").send_signal(signal.SIGSTOP)
    finished = running.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "sensor stopped answering"
    assert len(load_record(finished.run_dir)["plant_step"]) > 10
    assert running.left_behind() == []


def test_the_loop_and_its_record_outlast_a_frozen_control_plane(start: Start) -> None:
    """The coordinator routes all telemetry; what it holds up is sent again at the end."""
    running = start(*settings(speed=5.0, horizon_s=20.0))
    wait_recording(running)
    running.process.send_signal(signal.SIGSTOP)
    time.sleep(1.2)
    running.process.send_signal(signal.SIGCONT)
    finished = running.finish()
    assert finished.status == 0, finished.stderr
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["reached_s"] == 20.0
    assert finished.summary["identity_residual_max"] < 1e-11


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"]
)
def test_a_signal_ends_a_run_cleanly(start: Start, number: signal.Signals, status: int) -> None:
    running = start(*LONG)
    wait_recording(running)
    running.process.send_signal(number)
    finished = running.finish()
    assert finished.status == status
    assert finished.summary["exit"]["reason"] == f"stopped by {number.name}"
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["lost_outside_netem"] == 0
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


@pytest.mark.parametrize("role", ["plant", "sensor", "netem", "controller", "control"])
def test_a_taken_port_is_one_clear_line(tmp_path: Path, role: str) -> None:
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
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert f"127.0.0.1:{port} " in line
    assert f"set ports.{role} to another port, or to 0 for any" in line


def test_a_violated_assumption_is_reported_with_its_time(tmp_path: Path) -> None:
    finished = run_scenario(
        tmp_path,
        *settings(
            speed=5.0, horizon_s=10.0, mode="zoh", network__mansd=1, network__enforce_mansd=False
        ),
    )
    assert finished.status == 0
    seen = finished.summary["assumption_violations"]
    violations = [violation for violation in seen if violation["process"] == "controller"]
    record = load_record(finished.run_dir)
    deliveries = record["controller_delivery"]
    long_gaps = deliveries[deliveries["dropouts"] > 1]
    assert len(violations) == len(long_gaps) > 0
    for violation, gap in zip(violations, long_gaps, strict=True):
        assert violation["t_s"] == pytest.approx(gap["t_ns"] * 1e-9)
        assert violation["process"] == "controller"
        assert f"{gap['dropouts']} successive dropouts" in violation["what"]


def test_a_violation_that_no_delivery_follows_is_reported(tmp_path: Path) -> None:
    finished = run_scenario(
        tmp_path,
        *settings(speed=5.0, horizon_s=10.0, network__enforce_mansd=False, network__mansd=2),
        *settings(network__loss={}, network__loss__model="worst_case"),
    )
    (violation,) = finished.summary["assumption_violations"]
    events = load_record(finished.run_dir)["sensor_measurement"]
    event_ns = events["t_ns"][events["event"] >= 0]
    assert violation["t_s"] == pytest.approx(event_ns[3] * 1e-9)  # t_0 passes, two may be lost
    assert finished.summary["longest_drop_run"] == len(event_ns) - 1 > 2


def test_a_run_that_diverges_says_when_and_keeps_its_record(tmp_path: Path) -> None:
    finished = run_scenario(
        tmp_path,
        *settings(speed=2.0, horizon_s=4.0, model__parameters__a11=500.0),
    )
    assert finished.status == 1
    assert finished.summary["exit"]["reason"].startswith("diverged: x is not finite at ")
    steps = load_record(finished.run_dir)["plant_step"]
    lost = ~np.isfinite(steps["x"]).all(axis=1)
    assert finished.summary["diverged_at_s"] == pytest.approx(steps["t_ns"][lost][0] * 1e-9)
    assert finished.summary["final_state_norm"] is None
    assert "diverged: x is not finite" in (finished.run_dir / "report.html").read_text()


def test_a_run_that_cannot_keep_up_does_not_claim_its_horizon(tmp_path: Path) -> None:
    finished = run_scenario(
        tmp_path,
        *settings(speed=1000.0, horizon_s=2000.0, plant__rate_hz=500.0, plant__measure_every=100),
    )
    assert finished.status == 1
    assert "too slow" in finished.summary["exit"]["reason"]
    assert finished.summary["reached_s"] < 2000.0


def test_a_reader_that_leaves_does_not_end_the_run(tmp_path: Path) -> None:
    command = noack_command(
        "run", "lane_following", "--runs", str(tmp_path), *EPHEMERAL,
        *settings(speed=2.0, horizon_s=4.0),
    )  # fmt: skip
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        assert "events" in process.stderr.readline()
        process.stderr.close()
        assert process.wait(timeout=60) == 0
    assert len(load_record(tmp_path / "latest")["plant_step"]) == 2001


def test_a_run_under_way_is_not_touched_by_a_summary(start: Start) -> None:
    running = start(*settings(speed=2.0, horizon_s=6.0))
    wait_recording(running)
    run_dir = (running.runs / "latest").resolve()
    done = subprocess.run(
        noack_command("summary", str(run_dir)), capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "still under way" in done.stderr
    finished = running.finish()
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["reached_s"] == 6.0


def test_a_process_that_never_comes_to_the_start_is_named(start: Start) -> None:
    """Frozen before the barrier: no liveliness token tells of it yet."""
    running = start(*LONG)
    own = psutil.Process(running.process.pid)
    wait_for(lambda: any("sensor_node" in c.cmdline() for c in own.children()))
    (sensor,) = [c for c in own.children() if "sensor_node" in c.cmdline()]
    sensor.send_signal(signal.SIGSTOP)
    finished_error = running.finish_unstarted()
    assert "sensor did not come to the start" in finished_error
    assert not sensor.is_running()


def test_rows_of_a_process_that_wakes_up_late_are_merged(tmp_path: Path) -> None:
    finished = run_scenario(tmp_path, *settings(speed=5.0, horizon_s=4.0))
    record = load_record(finished.run_dir)
    writer = SpoolWriter(finished.run_dir / "spool", "plant")
    late = record["plant_step"][-30:].copy()
    late["input"] += 30
    writer.append("plant_step", 0, record["plant_step"][-60:].tobytes())
    writer.append("plant_step", 60, late.tobytes())
    writer.close()
    done = subprocess.run(
        noack_command("summary", str(finished.run_dir), "--json"),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    merged = load_record(finished.run_dir)
    assert len(merged["plant_step"]) > len(record["plant_step"])
    for table in ("sensor_measurement", "controller_step", "netem_packet"):
        assert np.array_equal(merged[table], record[table])
    assert not (finished.run_dir / "spool").exists()


def test_forged_datagrams_are_counted_and_ignored(start: Start) -> None:
    running = start(*settings(speed=2.0, horizon_s=8.0))
    wait_recording(running)
    ports = {
        role: [
            connection.laddr.port
            for connection in running.child(role).net_connections("udp4")
            if connection.status == "NONE" and not connection.raddr
        ]
        for role in ("plant", "sensor", "controller", "netem")
    }
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forger:
        for (port,) in ports.values():
            for size in (0, 1, 31, 48, 80, 600):
                forger.sendto(os.urandom(size), ("127.0.0.1", port))
            # Looks like an update of the farthest future.
            forger.sendto(b"NA\x01\x02" + b"\xff" * 76, ("127.0.0.1", port))
    finished = running.finish()
    assert finished.status == 0
    for role in ports:
        rejected = finished.summary["rejected_datagrams"][role]
        assert sum(rejected.values()) == 7, rejected
    assert finished.summary["identity_residual_max"] < 1e-11
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["lost_outside_netem"] == 0
    assert finished.summary["drops"] + finished.summary["deliveries"] == finished.summary["events"]

"""Faults and disturbances of processes, disks and streams: they are named, and no row is lost."""

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from cosim.live.finalize import reopen
from cosim.record.run_record import load_record
from netem.core.errors import MachineError
from noack.protocol.roles import LOOP_ROLES, ROLES
from tests.helpers import live_runs as live
from tests.helpers.command_line import invoke
from tests.integration.impatient import LEASE_S

pytestmark = pytest.mark.live

Start = Callable[..., live.Running]
LONG = [*live.AT_RATE, *live.settings(speed=4.0, horizon_s=400.0)]


def test_a_frozen_recorder_is_named_and_no_row_is_lost(start: Start) -> None:
    """The run ends because it has no recorder; the other processes store their rows themselves."""
    running = start(*LONG, impatient=True)
    running.wait_recording()
    running.child("recorder").send_signal(signal.SIGSTOP)
    finished = running.finish()
    assert finished.status == 1
    assert (
        finished.summary["exit"]["reason"]
        == "recorder is stopped (state T), by a signal such as SIGSTOP or by a debugger"
    )
    live.assert_complete(finished.loop)
    steps = load_record(finished.run_dir)["plant_step"]
    # Rows exist up to the end of the lease.
    assert len(steps) > 0.7 * LEASE_S * 4 * live.RATE_HZ
    assert np.array_equal(steps["sequence"], np.arange(len(steps)))
    assert not (finished.run_dir / "spool").exists()
    assert live.private_files(running.runs.parent) == []
    assert running.left_behind() == []


@pytest.mark.parametrize("role", ["netem", "recorder"])
def test_a_killed_process_ends_the_run_and_no_recorded_row_is_lost(start: Start, role: str) -> None:
    """The rows of the others are complete; the killed one may not have handed over its last ones."""
    running = start(*LONG)
    running.wait_recording()
    live.wait_for(lambda: len(live.spooled(running, "netem_packet")) > 0)
    running.child(role).kill()
    finished = running.finish()
    assert finished.status == 1
    reason = f"{role} died: killed by SIGKILL"
    assert finished.summary["exit"] == {"status": 1, "reason": reason}
    assert len([line for line in finished.stderr.splitlines() if reason in line]) == 1
    assert finished.loop["missing_by_table"] == {}
    assert finished.loop["identity_residual_relative"] < 1e-11
    assert finished.loop["replay"]["bit_exact"], finished.loop["replay"]
    record = load_record(finished.run_dir)
    assert record.reports.keys() == set(LOOP_ROLES) - {role}
    for table in ("plant_step", "controller_step"):
        numbers = record[table]["sequence"]
        assert np.array_equal(numbers, np.arange(len(numbers)))
        assert len(numbers) > 10
    assert not (finished.run_dir / "spool").exists()
    assert running.left_behind() == []


@pytest.mark.usefixtures("no_report", "no_recording")
def test_a_killed_launcher_leaves_no_process_behind(start: Start) -> None:
    running = start(*LONG)
    running.wait_recording()
    running.process.kill()
    assert running.left_behind() == []
    run_dir = (running.runs / "latest").resolve()
    outcome = reopen(run_dir)
    assert (outcome.status, outcome.reason) == (1, "the launcher ended early")
    (loop,) = outcome.summary.loops
    assert loop.missing_by_table == {}
    assert loop.replay is not None
    assert loop.replay.bit_exact
    steps = load_record(run_dir)["plant_step"]["sequence"]
    assert len(steps) > 10
    assert np.array_equal(steps, np.arange(len(steps)))


@pytest.mark.usefixtures("no_report", "no_recording")
def test_a_process_that_is_not_ready_in_time_is_named(start: Start) -> None:
    """It is frozen before the start barrier, so that it has no liveliness token."""
    short = live.settings(start_within_s=2.0)
    running = start(*LONG, *short, impatient=True, environment={"FROZEN": "sensor"})
    live.wait_for(lambda: live.child_of(running.process, "sensor") is not None)
    sensor = live.child_of(running.process, "sensor")
    assert sensor is not None
    error = running.finish_unstarted()
    # On a busy machine, other processes may not be ready, either.
    # On a slow one, the time to be ready is longer than that after which a stopped process is named.
    reason = re.search(r"sensor (is stopped \(state T\)|.*not ready in time: waited \d+ s.* cores)", error)
    assert reason is not None, error
    assert not sensor.is_running()
    outcome = reopen(max(running.runs.glob("*-lane_following")))
    assert outcome.status == 1
    assert error.startswith(f"{outcome.reason} (logs in ")


HORIZON_S = 4.0
SHORT = [*live.AT_RATE, *live.settings(speed=4.0, horizon_s=HORIZON_S)]
F_SETPIPE_SZ = 1031
AS_A_TERMINAL = os.environ | live.WITHOUT_VIEWER | {"FORCE_COLOR": "1", "TERM": "dumb"}
"""A terminal that cannot redraw a line: progress is printed line by line, also to a pipe."""


def run(runs: Path) -> list[str]:
    return live.noack_command("run", "lane_following", "--runs", str(runs), *live.BARE, *SHORT)


def is_whole(run_dir: Path) -> bool:
    steps = load_record(run_dir)["plant_step"]
    return np.array_equal(steps["sequence"], np.arange(HORIZON_S * live.RATE_HZ + 1))


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="sets the size of a pipe")
def test_a_full_and_then_closed_pipe_does_not_disturb_the_run(tmp_path: Path) -> None:
    """The launcher is blocked until the reader of its progress closes the pipe."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, F_SETPIPE_SZ, 4096)
    process = subprocess.Popen(run(tmp_path), stdout=subprocess.DEVNULL, stderr=writing, env=AS_A_TERMINAL)
    os.close(writing)
    try:
        rows = tmp_path / "latest" / "spool" / "plant_step.recorder"  # from the start on
        live.wait_for(lambda: rows.exists() or process.poll() is not None)
        filling = os.open(f"/proc/self/fd/{reading}", os.O_WRONLY | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(filling, b"x")
        os.close(filling)

        def has_ended() -> bool:
            """Whether the loop and the recorder have: none runs, reaped by the launcher or not."""
            return all(live.child_of(process, role) is None for role in ROLES)

        live.wait_for(has_ended)  # although the pipe is not read
    finally:
        os.close(reading)
        status = process.wait(live.PATIENCE_S)
    assert status == 0
    assert is_whole((tmp_path / "latest").resolve())


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 MiB that contains the runs of ``start``."""
    path = tmp_path / "runs"
    path.mkdir()
    if os.geteuid() != 0:
        pytest.skip("only root may mount a disk")
    command = ["mount", "-t", "tmpfs", "-o", "size=64m", "noack-test", str(path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        pytest.skip(f"no disk can be mounted here: {result.stderr.strip()}")
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


def fill(disk: Path) -> None:
    free_bytes = shutil.disk_usage(disk).free
    with (disk / "filler").open("wb", buffering=0) as file:
        while free_bytes > 0:  # other processes may write at the same time
            try:
                free_bytes -= file.write(bytes(min(free_bytes, 1 << 16)))
            except OSError:
                break


@pytest.mark.usefixtures("no_drawing")
def test_a_run_on_a_disk_that_fills_up_can_be_finalised_later(start: Start, small_disk: Path) -> None:
    running = start(*live.AT_RATE, *live.settings(speed=4.0, horizon_s=240.0))
    running.wait_recording()
    run_dir = (running.runs / "latest").resolve()
    # The disk is full: the run fails with the reason, and keeps what was recorded.
    fill(small_disk)
    stdout, stderr = running.process.communicate(timeout=live.PATIENCE_S)
    lines = [line for line in stderr.splitlines() if line.startswith("noack")]
    assert running.process.returncode == 1
    # Whoever writes first on the full disk: the recorder, or a process for which it is too slow.
    # "ended early": a recorder that needs more than 5 s to exit is not waited for.
    reason = f": {run_dir / 'spool'}: the record cannot be written: No space left on device"
    assert lines[0].startswith("noack: the run failed: ")
    assert lines[0].replace(" ended early", "").endswith(reason)
    assert lines[1].startswith(f"noack: {run_dir / 'record'}: the record cannot be written: No spa")
    assert f"kept in {run_dir / 'spool'}" in lines[1]
    assert len(lines) == 2, stderr
    assert "No space left on device" in stdout  # as JSON
    assert running.left_behind() == []
    spooled = {path.name: path.stat().st_size for path in (run_dir / "spool").iterdir()}
    # It is still full: the same reason again, and nothing is lost.
    with pytest.raises(MachineError) as error:
        reopen(run_dir)
    assert str(error.value).splitlines() == [line.removeprefix("noack: ") for line in lines]
    assert {path.name: path.stat().st_size for path in (run_dir / "spool").iterdir()} == spooled
    # There is space again: the record has all rows that were on disk.
    (small_disk / "filler").unlink()
    assert invoke("summary", run_dir).exit_code == 0
    record = load_record(run_dir)
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        bytes_on_disk = sum(size for name, size in spooled.items() if name.startswith(table))
        batches_at_most, row_bytes = len(rows) / 4 + 2, rows.itemsize + 2  # and the loop
        assert len(rows) * row_bytes >= bytes_on_disk - 16 * batches_at_most - row_bytes
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert not (run_dir / "spool").exists()
    summary = json.loads((run_dir / "summary.json").read_text())
    assert summary["exit"]["status"] == 1
    failed = summary["exit"]["reason"]
    assert lines[0] == f"noack: the run failed: {failed}"
    assert failed in (run_dir / "report.html").read_text()
    assert not list(run_dir.rglob("*.partial"))

"""Faults and disturbances of processes, disks and streams: they are named, and no row is lost."""

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import pytest

from cosim.live.finalize import reopen
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import MachineError
from noack.protocol.roles import ROLES
from tests.cosim.output.viewer.recordings import read
from tests.helpers import live_runs as live
from tests.helpers.command_line import invoke
from tests.helpers.waiting import is_left

Start = Callable[..., live.Running]
LONG = [*live.AT_RATE, *live.settings(speed=4.0, horizon_s=400.0)]


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


@pytest.mark.usefixtures("no_report", "no_recording")
def test_a_killed_launcher_leaves_no_process_behind(start: Start) -> None:
    running = start(*LONG)
    running.wait_recording()
    running.process.kill()
    assert running.left_behind() == []
    run_dir = (running.runs / "latest").resolve()
    assert reopen(run_dir).reason == "the launcher ended early"
    assert len(load_record(run_dir)["plant_step"]) > 10


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
    reason = re.search(r"sensor\b.* not ready in time: waited \d+ s.* cores", error)
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


def test_a_run_with_closed_streams_is_complete(tmp_path: Path) -> None:
    """Closed by a shell's ``<&- >&- 2>&-``: files opened next get the descriptors 0 to 2."""
    shell = ["/bin/sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *run(tmp_path)]
    environment = os.environ | live.WITHOUT_VIEWER
    assert subprocess.run(shell, env=environment, timeout=live.PATIENCE_S).returncode == 0
    run_dir = (tmp_path / "latest").resolve()
    assert is_whole(run_dir)
    assert {log.read_text() for log in (run_dir / "logs").iterdir()} == {""}


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
def small(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 MiB that contains the runs of ``start``."""
    path = tmp_path / "runs"
    path.mkdir()
    if os.geteuid() != 0:
        pytest.skip("only root may mount a disk")
    command = ["mount", "-t", "tmpfs", "-o", "size=64m", "noack-test", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"no disk can be mounted here: {done.stderr.strip()}")
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


def fill(disk: Path) -> None:
    room = shutil.disk_usage(disk).free
    with (disk / "filler").open("wb", buffering=0) as file:
        while room > 0:  # other processes may write at the same time
            try:
                room -= file.write(bytes(min(room, 1 << 16)))
            except OSError:
                break


@pytest.mark.usefixtures("no_drawing")
def test_a_run_on_a_disk_that_fills_up_can_be_finalised_later(start: Start, small: Path) -> None:
    running = start(*live.AT_RATE, *live.settings(speed=4.0, horizon_s=240.0))
    running.wait_recording()
    run_dir = (running.runs / "latest").resolve()
    fill(small)
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

    with pytest.raises(MachineError) as refused:
        reopen(run_dir)
    assert str(refused.value).splitlines() == [line.removeprefix("noack: ") for line in lines]
    assert {path.name: path.stat().st_size for path in (run_dir / "spool").iterdir()} == spooled

    (small / "filler").unlink()
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


DISTURBED_S = 36.0
PAUSE_S = 0.7
"""Well below zenoh's lease, and far above every delay that a certificate allows."""
SILENT_S = 3.0
"""Above the lease: all connections break, come back, and rows are sent again."""


class Disturbed(NamedTuple):
    """A finished run, its record, and its live viewer's processes."""

    finished: live.Finished
    record: RunRecord
    left_behind: list[psutil.Process]
    viewers: list[psutil.Process]
    viewer_group: int


def pause(process: psutil.Process, pause_s: float) -> None:
    process.send_signal(signal.SIGSTOP)
    time.sleep(pause_s)
    process.send_signal(signal.SIGCONT)


def viewers_of(running: live.Running) -> list[psutil.Process]:
    """Return the server of the recording and the server of rerun's page."""
    return [
        child
        for child in running.child("recorder").children(recursive=True)
        if "cosim.output.viewer.recording_viewer" in live.command_of(child) or is_rerun(child)
    ]


def is_rerun(process: psutil.Process) -> bool:
    try:
        return "rerun" in Path(process.exe()).name
    except psutil.Error:  # the process has ended
        return False


def disturbed_run(folder: Path) -> Disturbed:
    with pytest.MonkeyPatch.context() as environment, live.start_runs(folder) as start:
        for name in [name for name in os.environ if "DISPLAY" in name]:
            environment.delenv(name)  # the viewer opens in a browser
        values = live.settings(speed=4.0, horizon_s=DISTURBED_S)
        running = start(*live.AT_RATE, *values, "--live", viewer=True)
        running.wait_recording()
        viewers = viewers_of(running)
        (group,) = {os.getpgid(viewer.pid) for viewer in viewers}
        os.killpg(group, signal.SIGSTOP)
        for role in ROLES:
            pause(running.child(role), PAUSE_S)
        # The launcher's process routes all telemetry.
        pause(psutil.Process(running.process.pid), SILENT_S)
        finished = running.finish()
        record = load_record(finished.run_dir)
        return Disturbed(finished, record, running.left_behind(), viewers, group)


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Disturbed:
    """A run that the machine has not stalled at its horizon, where no step can be made up for."""
    for _ in range(3):
        run = disturbed_run(tmp_path_factory.mktemp("disturbed"))
        if ": overrun: " not in run.finished.summary["exit"]["reason"]:
            break
    assert run.finished.status == 0, run.finished.stderr
    return run


def test_every_step_is_executed_recorded_and_replayed(disturbed: Disturbed) -> None:
    """The steps due during a pause are executed late and in order."""
    summary, record = disturbed.finished.summary, disturbed.record
    assert summary["exit"]["reason"] == "horizon"
    assert summary["reached_s"] == DISTURBED_S
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert len(record["plant_step"]) == DISTURBED_S * live.RATE_HZ + 1
    for table in record.tables:
        assert (np.diff(record[table]["now_ns"]) >= 0).all()
    loop = disturbed.finished.loop
    live.assert_complete(loop)
    assert loop["identity_residual_relative"] < 1e-11
    assert loop["longest_loss_burst"] <= summary["mansd"]
    assert disturbed.left_behind == []


def test_inputs_too_old_for_a_certificate_make_its_claims_void(disturbed: Disturbed) -> None:
    record = disturbed.record
    for role in ("plant", "sensor", "controller"):  # netem may have had no packet
        assert disturbed.finished.loop["lateness_us"][role]["max"] > 0.9e6 * PAUSE_S
    certified = [claim for claim in disturbed.finished.loop["claims"] if "certificate" in claim["source"]]
    assert certified
    for claim in certified:
        assert claim["verdict"] == "void"
        assert 0 <= claim["since_s"] < DISTURBED_S
    late = [notice["text"] for notice in record.notices if notice["level"] == "late"]
    assert any(" s old, " in text or "took effect after " in text for text in late), late
    for text in late:
        assert disturbed.finished.stderr.count(text) == 1
    own = [claim for claim in disturbed.finished.loop["claims"] if claim["source"] == "(I1)"]
    assert {claim["verdict"] for claim in own} == {"held"}


def test_the_recording_is_complete_and_the_stalled_viewer_is_ended(disturbed: Disturbed) -> None:
    assert len(disturbed.viewers) == 2
    assert "live view: http://127.0.0.1:" in disturbed.finished.stderr
    chunks = read(disturbed.finished.run_dir / "recording.rrd")
    assert sum(chunk.num_rows for chunk in chunks["error/log10"]) > DISTURBED_S * live.RATE_HZ
    live.wait_for(lambda: not is_left(disturbed.viewer_group))
    assert all(live.is_over(viewer) for viewer in disturbed.viewers)


PACKAGES = ("noack", "plant_server", "sensor_node", "controller_node", "netem", "cosim")
WALL_CLOCK = {
    "noack/runtime/command_line.py": "lines of the log",
    "noack/plants/systems/code_cache.py": "ages of files",
    "cosim/record/run_directory.py": "the run's name and its environment",
    "cosim/live/coordination/coordinator.py": "when a change was requested",
    "cosim/live/coordination/remote_access.py": "the validity of an invitation",
    "noack/protocol/ros2_node.py": "the time stamps of messages of ROS 2",
    "netem/relay/relay.py": "the times of a capture",
    "netem/control/command_queue.py": "lines of statistics",
    "native/relay/loop.c": "time stamps of the kernel, compared with the monotonic clock",
    "noack/runtime/host_clocks/time_exchange.py": "the same",
}


def test_no_time_of_a_run_is_read_from_the_wall_clock() -> None:
    root = Path(__file__).parents[2]
    folders = (*PACKAGES, "native")
    reads = re.compile(r"\btime\.time(_ns)?\(|CLOCK_REALTIME\)|datetime\.(now|today)\(|utcnow")
    readers = {
        str(path.relative_to(root))
        for folder in folders
        for path in (root / folder).rglob("*.[pc]*")
        if path.suffix in (".py", ".c") and reads.search(path.read_text())
    }
    assert readers == WALL_CLOCK.keys()

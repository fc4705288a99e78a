"""A run survives disturbances: paused processes, a stepped wall clock, a stalled live viewer."""

import mmap
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import pytest

from cosim.record.run_record import RunRecord, load_record
from noack.protocol.topology import ROLES
from tests.cosim.output.viewer.test_viewer import is_left, read
from tests.integration import conftest as live

HORIZON_S = 36.0
HOUR_S = 3600
PAUSE_S = 0.7
"""Well below zenoh's lease, and far above every delay that a certificate allows."""
SILENT_S = 3.0
"""Above the lease: all connections break, come back, and rows are sent again."""
CLOCKS = "import sys, time\nfor _ in sys.stdin: print(time.time(), time.monotonic(), flush=True)"


class WallClock:
    """A wall clock that can be stepped, for processes with its environment.

    Args:
        folder: the folder for its files.
    """

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None or sys.platform != "linux":
            pytest.skip("needs Linux and a C compiler")
        library, offset = folder / "stepped_clock.so", folder / "offset"
        source = Path(__file__).with_name("stepped_clock.c")
        command = [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"]
        subprocess.run(command, check=True)
        offset.write_bytes(bytes(8))
        with offset.open("r+b") as file:
            self._offset_s = mmap.mmap(file.fileno(), 8)
        self.environment = {"LD_PRELOAD": str(library), "STEPPED_CLOCK": str(offset)}

    def step_to(self, offset_s: int) -> tuple[float, float]:
        """Set the offset from the true time; return the offsets of both clocks in a process."""
        self._offset_s[:] = offset_s.to_bytes(8, sys.byteorder, signed=True)
        done = subprocess.run(
            [sys.executable, "-S", "-c", CLOCKS],
            input="\n", capture_output=True, text=True, env=os.environ | self.environment,
            check=True,
        )  # fmt: skip
        wall_s, monotonic_s = map(float, done.stdout.split())
        return wall_s - time.time(), monotonic_s - time.monotonic()


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
        if "cosim.output.viewer.live_viewer" in live.command_of(child) or is_rerun(child)
    ]


def is_rerun(process: psutil.Process) -> bool:
    try:
        return "rerun" in Path(process.exe()).name
    except psutil.Error:  # the process has ended
        return False


def disturbed_run(folder: Path) -> Disturbed:
    clock = WallClock(folder)
    with pytest.MonkeyPatch.context() as environment, live.begun(folder) as start:
        for name in [name for name in os.environ if "DISPLAY" in name]:
            environment.delenv(name)  # the viewer opens in a browser
        for name, value in clock.environment.items():
            environment.setenv(name, value)
        running = start(*live.AT_RATE, *live.settings(speed=4.0, horizon_s=HORIZON_S), "--live")
        for name in clock.environment:
            environment.delenv(name)
        running.wait_recording()
        viewers = viewers_of(running)
        (group,) = {os.getpgid(viewer.pid) for viewer in viewers}
        os.killpg(group, signal.SIGSTOP)
        for hours, role in zip((1, -1, 0, 1, 0), ROLES, strict=True):
            child = running.child(role)
            assert "stepped_clock" in Path(f"/proc/{child.pid}/maps").read_text()
            pause(child, PAUSE_S)
            wall_s, monotonic_s = clock.step_to(hours * HOUR_S)
            assert wall_s == pytest.approx(hours * HOUR_S, abs=HOUR_S / 2)
            assert abs(monotonic_s) < HOUR_S / 2
        # The launcher's process routes all telemetry.
        pause(psutil.Process(running.process.pid), SILENT_S)
        finished = running.finish()
        record = load_record(finished.run_dir)
        return Disturbed(finished, record, running.left_behind(), viewers, group)


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Disturbed:
    """A run that the machine has not stalled at its horizon, where no step can be made up for."""
    for _ in range(3):
        found = disturbed_run(tmp_path_factory.mktemp("disturbed"))
        if ": overrun: " not in found.finished.summary["exit"]["reason"]:
            break
    assert found.finished.status == 0, found.finished.stderr
    return found


def test_every_step_is_executed_recorded_and_replayed(disturbed: Disturbed) -> None:
    """The steps due during a pause are executed late and in order."""
    summary, record = disturbed.finished.summary, disturbed.record
    assert summary["exit"]["reason"] == "horizon"
    assert summary["reached_s"] == HORIZON_S
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert len(record["plant_step"]) == HORIZON_S * live.RATE_HZ + 1
    loop = disturbed.finished.loop
    live.assert_complete(loop)
    assert loop["identity_residual_relative"] < 1e-11
    assert loop["longest_loss_burst"] <= summary["mansd"]
    assert disturbed.left_behind == []


def test_inputs_too_old_for_a_certificate_make_its_claims_void(disturbed: Disturbed) -> None:
    record = disturbed.record
    for role in ("plant", "sensor", "controller"):  # netem may have had no packet
        assert disturbed.finished.loop["lateness_us"][role]["max"] > 0.9e6 * PAUSE_S
    certified = [
        claim for claim in disturbed.finished.loop["claims"] if "certificate" in claim["source"]
    ]
    assert certified
    for claim in certified:
        assert claim["verdict"] == "void"
        assert 0 <= claim["since_s"] < HORIZON_S
    late = [notice["text"] for notice in record.notices if notice["level"] == "late"]
    assert any(" s old, " in text or "took effect after " in text for text in late), late
    for text in late:
        assert disturbed.finished.stderr.count(text) == 1
    own = [claim for claim in disturbed.finished.loop["claims"] if claim["source"] == "(I1)"]
    assert {claim["verdict"] for claim in own} == {"held"}


def test_no_time_depends_on_the_wall_clock(disturbed: Disturbed) -> None:
    for table in disturbed.record.tables:
        now_ns = disturbed.record[table]["now_ns"]
        assert (np.diff(now_ns) >= 0).all()
        assert now_ns.max(initial=0) < HOUR_S / 2 * 1e9
    for lateness in disturbed.finished.loop["lateness_us"].values():
        assert (lateness["max"] or 0) < 1e6 * HOUR_S / 2


def test_the_recording_is_complete_and_the_stalled_viewer_is_ended(disturbed: Disturbed) -> None:
    assert len(disturbed.viewers) == 2
    assert "live view: http://127.0.0.1:" in disturbed.finished.stderr
    chunks = read(disturbed.finished.run_dir / "recording.rrd")
    assert sum(chunk.num_rows for chunk in chunks["error/log10"]) > HORIZON_S * live.RATE_HZ
    live.wait_for(lambda: not is_left(disturbed.viewer_group))
    assert all(live.is_over(viewer) for viewer in disturbed.viewers)

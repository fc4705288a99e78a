"""A live viewer that stalls during the run."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from cosim.record.run_record import load_record
from tests.cosim.output.viewer.test_viewer import is_left, read
from tests.integration.conftest import (
    AT_RATE,
    RATE_HZ,
    Running,
    command_of,
    is_over,
    settings,
    wait_for,
)
from tests.integration.test_faults import wait_recording

Start = Callable[..., Running]


def is_rerun(process: psutil.Process) -> bool:
    try:
        return "rerun" in Path(process.exe()).name
    except psutil.Error:  # the process has ended
        return False


@pytest.fixture
def in_a_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if "DISPLAY" in name]:
        monkeypatch.delenv(name)


@pytest.mark.usefixtures("in_a_browser")
def test_a_stalled_viewer_does_not_disturb_the_run(start: Start) -> None:
    running = start(*AT_RATE, *settings(speed=4.0, horizon_s=20.0), "--live")
    wait_recording(running)
    viewers = [
        child
        for child in running.child("recorder").children(recursive=True)
        if "cosim.output.viewer.live_viewer" in command_of(child) or is_rerun(child)
    ]
    (group,) = {os.getpgid(viewer.pid) for viewer in viewers}
    assert len(viewers) == 2  # the server of the recording and the server of rerun's page
    os.killpg(group, signal.SIGSTOP)
    finished = running.finish()
    assert finished.status == 0, finished.stderr
    assert "live view: http://127.0.0.1:" in finished.stderr
    assert finished.summary["exit"]["reason"] == "horizon"
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["replay"]["bit_exact"]
    assert finished.summary["replay"]["complete"]
    assert finished.summary["identity_residual_max"] < 1e-11
    assert len(load_record(finished.run_dir)["plant_step"]) == 20 * RATE_HZ + 1
    rows = sum(c.num_rows for c in read(finished.run_dir / "recording.rrd")["error/log10"])
    assert rows > 20 * RATE_HZ
    wait_for(lambda: not is_left(group))
    assert running.left_behind() == []
    assert all(is_over(viewer) for viewer in viewers)

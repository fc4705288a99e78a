"""Processes that are paused during a run: no row is lost, and claims end where the run is too late."""

import os
import signal
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import pytest

from cosim.record.run_record import RunRecord, load_record
from noack.protocol.roles import LOOP_ROLES, ROLES
from tests.cosim.output.viewer.recordings import read
from tests.helpers import live_runs as live
from tests.helpers.waiting import is_left
from tests.integration.impatient import LEASE_S

pytestmark = pytest.mark.live

DISTURBED_S = 12.0
PAUSE_S = 0.3
"""Well below the lease, and far above every delay that a certificate allows."""
SILENT_S = LEASE_S + 0.5
"""All connections break, come back, and rows are sent again."""


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
        values = live.settings(speed=2.0, horizon_s=DISTURBED_S)
        running = start(*live.AT_RATE, *values, "--live", viewer=True, impatient=True)
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
    return disturbed_run(tmp_path_factory.mktemp("disturbed"))


def test_every_step_is_executed_recorded_and_replayed(disturbed: Disturbed) -> None:
    """The steps due during a pause are executed late and in order."""
    summary, record = disturbed.finished.summary, disturbed.record
    assert summary["exit"] == {"status": 0, "reason": "horizon"}, disturbed.finished.stderr
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


def test_claims_end_where_inputs_are_too_old_for_a_certificate(disturbed: Disturbed) -> None:
    for role in ("plant", "sensor", "controller"):  # netem may have had no packet
        assert disturbed.finished.loop["lateness_us"][role]["max"] > 0.9e6 * PAUSE_S
    certified = [claim for claim in disturbed.finished.loop["claims"] if "certificate" in claim["source"]]
    assert certified
    for claim in certified:
        assert claim["verdict"] == "ended"
        assert 0 <= claim["since_s"] < DISTURBED_S
    kinds = {part["failure"]["kind"] for part in disturbed.finished.loop["conformance"]}
    assert kinds <= {"input", "limit", "when"}
    own = [claim for claim in disturbed.finished.loop["claims"] if claim["source"] == "(I1)"]
    assert {claim["verdict"] for claim in own} == {"held"}


def test_the_recording_is_complete_and_the_stalled_viewer_is_ended(disturbed: Disturbed) -> None:
    assert len(disturbed.viewers) == 2
    assert "live view: http://127.0.0.1:" in disturbed.finished.stderr
    chunks = read(disturbed.finished.run_dir / "recording.rrd")
    assert sum(chunk.num_rows for chunk in chunks["error/log10"]) > DISTURBED_S * live.RATE_HZ
    live.wait_for(lambda: not is_left(disturbed.viewer_group))
    assert all(live.is_over(viewer) for viewer in disturbed.viewers)


@pytest.mark.system
def test_a_run_is_complete_though_its_launcher_was_stopped_across_the_horizon(tmp_path: Path) -> None:
    """Its processes end meanwhile: their last rows and their reports are on disk."""
    with live.start_runs(tmp_path) as start:
        running = start(*live.AT_RATE, *live.settings(speed=4.0, horizon_s=10.0))
        running.wait_recording()
        processes = [running.child(role) for role in LOOP_ROLES]
        launcher = psutil.Process(running.process.pid)
        launcher.send_signal(signal.SIGSTOP)
        live.wait_for(lambda: all(live.is_over(process) for process in processes))
        launcher.send_signal(signal.SIGCONT)
        finished = running.finish()
    assert finished.summary["exit"] == {"status": 0, "reason": "horizon"}, finished.stderr
    assert finished.status == 0
    live.assert_complete(finished.loop)

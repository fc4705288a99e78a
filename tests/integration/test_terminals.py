"""A process that was started by hand, in its own terminal, is restarted by hand."""

import signal
import subprocess
from collections.abc import Callable

from noack.protocol.topology import LOOP_ROLES
from tests.integration.conftest import AT_RATE, PATIENCE_S, Running, settings


def test_a_process_may_be_restarted_by_hand(
    start: Callable[..., Running], by_hand: Callable[[str], subprocess.Popen[str]]
) -> None:
    recording = start(
        *AT_RATE,
        *settings(speed=2.0, horizon_s=1000.0, recovery__rejoin_within_s=60),
        command=("record", "lane_following"),
    )
    processes = {role: by_hand(role) for role in LOOP_ROLES}
    recording.wait_started()
    twice = by_hand("sensor")
    assert twice.wait(PATIENCE_S) == 1
    assert "another sensor is in this run already" in twice.communicate()[1]
    processes["sensor"].send_signal(signal.SIGINT)
    assert processes["sensor"].wait(PATIENCE_S) == 130
    again = by_hand("sensor")
    assert again.stderr is not None
    message = "replaces a process (sensor ended early: SIGINT)"
    assert any(message in line for line in iter(again.stderr.readline, ""))
    processes["plant"].send_signal(signal.SIGINT)  # the run ends without the plant
    finished = recording.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "plant ended early: SIGINT"
    assert "sensor ended early: SIGINT at " in finished.stderr
    assert "the run goes on, restart it with: noack sensor" in finished.stderr
    (restart,) = finished.loop["restarts"]
    assert restart["what"] == "restarted: sensor ended early: SIGINT"
    assert finished.loop["replay"]["bit_exact"]
    assert finished.loop["replay"]["complete"]  # on SIGINT, a process delivers all rows
    assert finished.loop["missing_samples"] == 0
    for process in (*processes.values(), again):
        process.communicate(timeout=PATIENCE_S)
    assert [processes[role].returncode for role in ("plant", "sensor")] == [130, 130]

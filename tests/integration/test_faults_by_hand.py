"""Processes started by hand: one is missing, or the coordinator is killed."""

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from cosim.live.finalize import reopen
from cosim.record.run_record import load_record
from noack.protocol.topology import LOOP_ROLES
from tests.integration import conftest as live
from tests.integration.conftest import ended

Start = Callable[..., live.Running]
ByHand = Callable[[str], subprocess.Popen[str]]
RECORD = ("record", "lane_following")


def test_a_wait_for_a_missing_process_can_be_interrupted(
    start: Start, by_hand: ByHand, tmp_path: Path
) -> None:
    recording = start(command=RECORD)
    own = psutil.Process(recording.process.pid)
    processes = {role: by_hand(role) for role in LOOP_ROLES if role != "netem"}
    assert recording.process.stderr is not None
    live.wait_for(lambda: recording.process.stderr.readline() == "waiting for netem\n")  # type: ignore[union-attr]
    children = own.children(recursive=True)
    recording.process.send_signal(signal.SIGINT)
    stdout, stderr = ended(recording.process)
    assert recording.process.returncode == 130
    (line,) = stderr.splitlines()
    assert line.startswith("noack: stopped by the user (SIGINT) (logs in ")
    assert json.loads(stdout)["exit"]["status"] == 130
    for role, process in processes.items():
        _, stderr = ended(process)
        assert process.returncode == 1
        why = stderr.splitlines()[-1].removeprefix(f"noack {role}: ")
        assert why in (
            "stopped by the user (SIGINT)",
            "lost the connection to the run's coordinator",
        ), stderr
    assert psutil.wait_procs(children, timeout=live.PATIENCE_S)[1] == []
    assert live.private_files(tmp_path) == []


def test_the_loop_outlives_the_coordinator(start: Start, by_hand: ByHand) -> None:
    """The loop reaches its horizon, and each process stores all of its rows itself."""
    horizon_s = 24.0  # a machine that stalls for seconds does not reach it before the kill
    recording = start(*live.AT_RATE, *live.settings(speed=4.0, horizon_s=horizon_s), command=RECORD)
    processes = {role: by_hand(role) for role in LOOP_ROLES}
    recording.wait_recording()
    run_dir = (recording.runs / "latest").resolve()
    recording.process.kill()
    ended(recording.process)
    for role, process in processes.items():
        stdout, stderr = ended(process)
        assert process.returncode == 0, stderr
        assert stderr.splitlines()[-1] == f"noack {role}: ended: horizon"
        assert json.loads(stdout)["ended"] == "horizon"
    assert recording.left_behind() == []
    outcome = reopen(run_dir)
    assert outcome.status == 1
    assert outcome.reason == "the launcher ended early"
    assert outcome.summary.reached_s == horizon_s
    assert outcome.summary.loops[0].missing_samples == 0
    replay = outcome.summary.loops[0].replay
    assert replay is not None
    assert replay.bit_exact
    steps = load_record(run_dir)["plant_step"]
    assert np.array_equal(steps["sequence"], np.arange(horizon_s * live.RATE_HZ + 1))

"""Processes started by hand: one is missing or ends, the coordinator dies, a key is kept."""

import contextlib
import json
import os
import signal
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import pytest

from cosim.live.finalize import reopen
from cosim.record.run_record import load_record
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.run_descriptor import parse_descriptor
from tests.helpers import live_runs as live

pytestmark = pytest.mark.live

Start = Callable[..., live.Running]
ByHand = Callable[[str], subprocess.Popen[str]]
RECORD = ("record", "lane_following")


@pytest.mark.usefixtures("no_report", "no_recording")
def test_the_loop_outlives_the_coordinator(start: Start, by_hand: ByHand) -> None:
    """The loop reaches its horizon, and each process stores all of its rows itself."""
    horizon_s = 24.0  # a machine that stalls for seconds does not reach it before the kill
    recording = start(*live.AT_RATE, *live.settings(speed=8.0, horizon_s=horizon_s), command=RECORD)
    processes = {role: by_hand(role) for role in LOOP_ROLES}
    recording.wait_recording()
    run_dir = (recording.runs / "latest").resolve()
    recording.process.kill()
    live.wait_for_end(recording.process)
    for role, process in processes.items():
        stdout, stderr = live.wait_for_end(process)
        assert process.returncode == 0, stderr
        assert stderr.splitlines()[-2:] == [
            f"noack {role}: cannot reach `noack record`; rows are kept in {run_dir}/spool; "
            f"`noack summary {run_dir}` completes the record",
            f"noack {role}: the run reached its horizon",
        ]
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


def files(folder: Path) -> dict[str, bytes]:
    contents = {}
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            if path.is_file():
                contents[str(path)] = path.read_bytes()
    return contents


def visible_in_processes(recording: live.Running, processes: list[subprocess.Popen[str]]) -> dict[str, bytes]:
    """Return command lines, environments and names of the processes."""
    launcher = psutil.Process(recording.process.pid)
    pids = [launcher.pid, *(child.pid for child in launcher.children(recursive=True))]
    paths = [
        Path(f"/proc/{pid}/{name}")
        for pid in (*pids, *(process.pid for process in processes))
        for name in ("cmdline", "environ", "comm")
    ]
    seen = {}
    for path in paths:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has ended
            seen[str(path)] = path.read_bytes()
    return seen


class ByHandRun(NamedTuple):
    """A run whose sensor was started twice, and which the sensor's end ended."""

    finished: live.Finished
    key: bytes
    seen: dict[str, bytes]
    """Everything in which the key could be seen, by place."""
    statuses: dict[str, int | None]
    """Of the processes, by role."""
    refused: str
    """What the second sensor printed."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ByHandRun:
    folder = tmp_path_factory.mktemp("by hand")
    private = folder / f"noack-{os.getuid()}"
    with live.start_runs(folder) as start, live.start_commands() as begin:

        def by_hand(role: str) -> subprocess.Popen[str]:
            return begin(role, "--json", runtime=folder)

        early = {role: by_hand(role) for role in LOOP_ROLES[:2]}
        values = live.settings(speed=2.0, horizon_s=1000.0)
        recording = start(*live.AT_RATE, *values, command=RECORD)
        descriptor = private / "default.json"
        live.wait_for(descriptor.exists)
        assert (stat.S_IMODE(descriptor.stat().st_mode), stat.S_IMODE(private.stat().st_mode)) == (
            0o600,
            0o700,
        )
        key = parse_descriptor(descriptor.read_text()).key
        processes = early | {role: by_hand(role) for role in LOOP_ROLES[2:]}
        recording.wait_recording()
        twice = by_hand("sensor")
        assert twice.wait(live.PATIENCE_S) == 1
        seen = visible_in_processes(recording, [*processes.values()])
        assert len(seen) >= 3 * 6
        run_dir = (recording.runs / "latest").resolve()
        seen |= files(run_dir) | files(private)
        del seen[str(descriptor)]  # the run descriptor contains the key
        processes["sensor"].send_signal(signal.SIGINT)
        finished = recording.finish()
        assert files(private) == {}
        seen |= files(run_dir) | {"recorder's output": finished.stderr.encode()}
        for role, process in processes.items():
            seen[f"{role}'s output"] = "".join(live.wait_for_end(process)).encode()
        statuses = {role: process.returncode for role, process in processes.items()}
        return ByHandRun(finished, key, seen, statuses, twice.communicate()[1])


def test_the_end_of_a_process_ends_the_run(run: ByHandRun) -> None:
    finished = run.finished
    assert "another sensor is in this run already" in run.refused
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "sensor ended early: SIGINT"
    assert "sensor ended early: SIGINT" in finished.stderr
    assert finished.loop["replay"]["bit_exact"]
    assert finished.loop["replay"]["complete"]  # on SIGINT, a process delivers all rows
    assert finished.loop["missing_samples"] == 0
    statuses = {"plant": 1, "sensor": 130, "netem": 1, "controller": 1}
    assert run.statuses == statuses


def test_the_key_of_a_run_by_hand_is_visible_in_its_descriptor_only(run: ByHandRun) -> None:
    for where, content in run.seen.items():
        assert run.key not in content, where
        assert run.key.hex().encode() not in content, where

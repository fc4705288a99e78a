"""What others can see of a run of which each process started by hand."""

import contextlib
import json
import os
import signal
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from cosim.record.run_record import load_record
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.join_ticket import loads
from tests.integration.conftest import (
    PATIENCE_S,
    Finished,
    Running,
    assert_complete,
    settings,
    wait_for,
)


class Watched:
    """A run started by hand, and all data visible of it."""

    def __init__(
        self,
        start: Callable[..., Running],
        by_hand: Callable[[str], subprocess.Popen[str]],
        private: Path,
    ) -> None:
        early = [by_hand(role) for role in LOOP_ROLES[:2]]
        recording = start(
            *settings(speed=2.0, horizon_s=400.0), command=("record", "lane_following")
        )
        path = private / "default.json"
        wait_for(path.exists)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(private.stat().st_mode) == 0o700
        self.ticket = loads(path.read_text())
        processes = early + [by_hand(role) for role in LOOP_ROLES[2:]]
        recording.wait_recording()
        run_dir = (recording.runs / "latest").resolve()
        self.seen = {
            "command lines and environments": _visible_in_processes(recording, processes),
            "the run directory": _files(run_dir),
            "the private folder": {
                name: content
                for name, content in _files(private).items()
                if name != path.name  # the ticket file contains the key
            },
        }
        recording.process.send_signal(signal.SIGINT)
        self.finished: Finished = recording.finish()
        self.seen["the finished run directory"] = _files(run_dir)
        self.seen["what was printed"] = {"recorder": self.finished.stderr.encode()}
        self.left = _files(private)
        self.ended = {}
        for role, process in zip(LOOP_ROLES, processes, strict=True):
            stdout, stderr = process.communicate(timeout=PATIENCE_S)
            self.seen["what was printed"][role] = (stdout + stderr).encode()
            self.ended[role] = (process.returncode, json.loads(stdout)["ended"])


def _files(folder: Path) -> dict[str, bytes]:
    found = {}
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            if path.is_file():
                found[str(path.relative_to(folder))] = path.read_bytes()
    return found


def _visible_in_processes(
    recording: Running, processes: list[subprocess.Popen[str]]
) -> dict[str, bytes]:
    """Return command lines, environments and names of the processes."""
    launcher = psutil.Process(recording.process.pid)
    pids = [launcher.pid, *(child.pid for child in launcher.children(recursive=True))]
    pids += [process.pid for process in processes]
    contents = {}
    for pid in pids:
        for name in ("cmdline", "environ", "comm"):
            contents[f"{pid}/{name}"] = Path(f"/proc/{pid}/{name}").read_bytes()
    return contents


def test_the_key_of_a_run_by_hand_is_visible_in_its_ticket_only(
    start: Callable[..., Running],
    by_hand: Callable[[str], subprocess.Popen[str]],
    tmp_path: Path,
) -> None:
    watched = Watched(start, by_hand, tmp_path / f"noack-{os.getuid()}")
    finished = watched.finished
    assert finished.status == 130, finished.stderr
    assert finished.summary["exit"]["reason"] == "stopped by the user (SIGINT)"
    assert_complete(finished.loop)
    assert finished.loop["identity_residual_max"] < 1e-11
    assert set(watched.ended.values()) == {(1, "stopped by the user (SIGINT)")}
    steps = load_record(finished.run_dir)["plant_step"]
    assert np.array_equal(steps["sequence"], np.arange(len(steps)))
    secrets = {
        "key": watched.ticket.key,
        "key in words": watched.ticket.key.hex().encode(),
    }
    for where, contents in watched.seen.items():
        for name, content in contents.items():
            for what, secret in secrets.items():
                assert secret not in content, f"{what} in {where}: {name}"
    assert len(watched.seen["command lines and environments"]) == 3 * 7  # with the fork server
    assert watched.left == {}

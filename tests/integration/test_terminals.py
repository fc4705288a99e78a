"""One process each, started by hand."""

import json
import os
import signal
import stat
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cosim.record import load_record
from tests.integration.conftest import Running, noack_command, settings, wait_for

ROLES = ("plant", "sensor", "controller", "netem")


@pytest.fixture
def by_hand(tmp_path: Path) -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Start one process as a person would; whatever is left is killed at the end."""
    started: list[subprocess.Popen[str]] = []

    def begin(role: str) -> subprocess.Popen[str]:
        started.append(_start_by_hand(role, tmp_path))
        return started[-1]

    yield begin
    for process in started:
        if process.poll() is None:
            process.kill()
            process.communicate()


def _start_by_hand(role: str, tmp_path: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        noack_command(role, "--json"),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},
    )


def test_five_terminals_in_any_order(
    start: Callable[..., Running],
    by_hand: Callable[[str], subprocess.Popen[str]],
    tmp_path: Path,
) -> None:
    early = [by_hand(role) for role in ROLES[:2]]
    recording = start(*settings(speed=5.0, horizon_s=10.0), command=("record", "lane_following"))
    (folder,) = [tmp_path / f"noack-{os.getuid()}"]
    ticket = folder / "default.json"
    wait_for(ticket.exists)
    assert stat.S_IMODE(ticket.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    key = json.loads(ticket.read_text())["key"].encode()
    late = [by_hand(role) for role in ROLES[2:]]
    finished = recording.finish()
    assert finished.status == 0, finished.stderr
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["lost_outside_netem"] == 0
    for process in early + late:
        stdout, stderr = process.communicate(timeout=30)
        assert process.returncode == 0, stderr
        assert json.loads(stdout)["ended"] == "horizon"
    assert not ticket.exists()
    for path in finished.run_dir.rglob("*"):
        assert not path.is_file() or key not in path.read_bytes()
    assert len(load_record(finished.run_dir)["plant_step"]) == 5001


def test_a_process_that_a_person_ends_is_named(
    start: Callable[..., Running], by_hand: Callable[[str], subprocess.Popen[str]]
) -> None:
    recording = start(*settings(speed=5.0, horizon_s=500.0), command=("record", "lane_following"))
    processes = {role: by_hand(role) for role in ROLES}
    recording.wait_started()
    processes["sensor"].send_signal(signal.SIGINT)
    finished = recording.finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"] == "sensor ended early: SIGINT"
    for process in processes.values():
        process.communicate(timeout=30)
    assert processes["sensor"].returncode == 130

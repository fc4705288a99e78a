"""Runs the real processes on ephemeral loopback ports, faster than the wall."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

EPHEMERAL = ("--set", "ports={}")
ROLE_MODULES = {
    "recorder": "cosim.recorder",
    "netem": "netem",
    "plant": "plant_server",
    "sensor": "sensor_node",
    "controller": "controller_node",
}
PATIENCE_S = 60.0


def noack_command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "cosim.cli", *arguments]


@dataclass(frozen=True)
class Finished:
    status: int
    summary: dict[str, Any]
    stderr: str
    run_dir: Path


def settings(**values: object) -> list[str]:
    """``--set`` options; a double underscore stands for the dot of a key."""
    pairs = []
    for key, value in values.items():
        pairs += ["--set", f"{key.replace('__', '.')}={json.dumps(value)}"]
    return pairs


def run_scenario(runs: Path, *arguments: str) -> Finished:
    done = subprocess.run(
        noack_command(
            "run", "lane_following", "--json", "--runs", str(runs), *EPHEMERAL, *arguments
        ),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    summary = json.loads(done.stdout)
    return Finished(done.returncode, summary, done.stderr, (runs / "latest").resolve())


class Running:
    """A run under way."""

    def __init__(self, runs: Path, process: subprocess.Popen[str]) -> None:
        self.runs = runs
        self.process = process
        self._children: list[psutil.Process] = []

    def wait_started(self) -> None:
        wait_for(lambda: (self.runs / "latest").exists() or self.process.poll() is not None)
        assert self.process.poll() is None, self.process.communicate()
        self._children = psutil.Process(self.process.pid).children(recursive=True)

    def child(self, role: str) -> psutil.Process:
        for child in self._children:
            if ROLE_MODULES[role] in child.cmdline():
                return child
        raise AssertionError(f"no process of {role}")

    def finish(self) -> Finished:
        stdout, stderr = self.process.communicate(timeout=PATIENCE_S)
        summary = json.loads(stdout)
        return Finished(self.process.returncode, summary, stderr, (self.runs / "latest").resolve())

    def finish_unstarted(self) -> str:
        """The error of a run that never began."""
        stdout, _ = self.process.communicate(timeout=PATIENCE_S)
        assert self.process.returncode == 1
        error: str = json.loads(stdout)["error"]
        return error

    def left_behind(self) -> list[psutil.Process]:
        _, alive = psutil.wait_procs(self._children, timeout=10)
        return alive


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.02)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    """Start ``noack run`` in the background; whatever is left is killed at the end."""
    started: list[Running] = []

    def begin(*arguments: str, command: tuple[str, ...] = ("run", "lane_following")) -> Running:
        process = subprocess.Popen(
            noack_command(
                *command, "--json", "--runs", str(tmp_path / "runs"), *EPHEMERAL, *arguments
            ),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},
        )
        running = Running(tmp_path / "runs", process)
        started.append(running)
        return running

    yield begin
    for running in started:
        if running.process.poll() is None:
            for child in psutil.Process(running.process.pid).children(recursive=True):
                child.kill()
            running.process.kill()
        running.process.communicate()

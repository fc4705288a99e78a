"""Run real processes on ephemeral loopback ports, faster than real time."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from cosim.record.run_record import Rows
from noack.protocol.roles import ROLES
from noack.runtime.spool import read_batches
from noack.scenario.resolution import ResolvedRun
from noack.scenario.scenario_file import load
from tests.helpers.command_line import invoke
from tests.helpers.waiting import PATIENCE_S, wait_for

EPHEMERAL = ("--set", "ports={}")
BARE = (*EPHEMERAL, "--set", "certificate.prove=false", "--no-report")
"""Without a report, and a search for witnesses; tests that need a report add ``--report``."""
WITHOUT_VIEWER = {"PYTHONPATH": str(Path(__file__).parents[1] / "integration" / "without_viewer")}
"""Of commands whose recording is not looked at."""


def noack_command(*arguments: str, impatient: bool = False, module: str = "cosim.cli") -> list[str]:
    """Return a command of noack; an impatient one waits less for processes that do not respond."""
    module = "tests.integration.impatient" if impatient else module
    return [sys.executable, "-m", module, *arguments]


Start = Callable[..., "subprocess.Popen[str]"]


@contextmanager
def start_commands() -> Iterator[Start]:
    """Start commands of noack; what still runs at the end is killed, with its children."""
    started: list[subprocess.Popen[str]] = []

    def start(
        *arguments: object,
        runtime: Path | None = None,
        before: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
        impatient: bool = False,
        module: str = "cosim.cli",
        viewer: bool = False,
        cwd: Path | None = None,
    ) -> subprocess.Popen[str]:
        command = noack_command(*map(str, arguments), impatient=impatient, module=module)
        variables = {} if runtime is None else {"XDG_RUNTIME_DIR": str(runtime)}
        variables |= {} if viewer else WITHOUT_VIEWER
        started.append(subprocess.Popen(
            [*before, *command], text=True, cwd=cwd, env=os.environ | variables | (environment or {}),
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        ))  # fmt: skip
        return started[-1]

    try:
        yield start
    finally:
        for process in started:
            if process.poll() is None:
                for child in psutil.Process(process.pid).children(recursive=True):
                    child.kill()
                process.kill()
            process.communicate()


def wait_for_end(process: "subprocess.Popen[str]") -> tuple[str, str]:
    """Wait for the end of a process; return what it printed."""
    return process.communicate(timeout=PATIENCE_S)


def assert_complete(loop: Mapping[str, Any]) -> None:
    """Check a loop's summary: all samples, no unintended loss, and a replay with the same bits."""
    assert loop["missing_samples"] == loop["unintended_losses"] == 0
    assert loop["replay"]["bit_exact"], loop["replay"]
    assert loop["replay"]["complete"]


@dataclass(frozen=True)
class Finished:
    """A run that has ended."""

    status: int
    summary: dict[str, Any]
    stderr: str
    run_dir: Path

    @property
    def loop(self) -> dict[str, Any]:
        """The summary of the run's first loop."""
        loop: dict[str, Any] = self.summary["loops"][0]
        return loop


def settings(**values: object) -> list[str]:
    """Return ``--set`` options; a double underscore means the dot of a key."""
    pairs = []
    for key, value in values.items():
        pairs += ["--set", f"{key.replace('__', '.')}={json.dumps(value)}"]
    return pairs


def command_of(process: psutil.Process) -> list[str]:
    """Return the command line of a process; empty if it has ended or was just forked."""
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:  # also for a zombie
        return []


def is_over(process: psutil.Process) -> bool:
    """Whether a process has ended, or is a zombie."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def is_of(role: str, process: psutil.Process) -> bool:
    """Whether a process has a role in a run, by its title; not if it has ended."""
    return command_of(process)[:1] == [f"noack {role}"]


def processes_of(launcher: psutil.Process) -> dict[str, psutil.Process]:
    """Return the processes of a run by role."""
    children = launcher.children()
    return {role: child for child in children for role in ROLES if is_of(role, child)}


def udp_port(process: psutil.Process) -> int:
    """Return the port of a process in the loop."""
    (port,) = {udp.laddr.port for udp in process.net_connections("udp4") if not udp.raddr}
    return int(port)


def child_of(parent: subprocess.Popen[Any], role: str) -> psutil.Process | None:
    """Return the running process of a role, or None."""
    return processes_of(psutil.Process(parent.pid)).get(role)


RATE_HZ = 100.0
AT_RATE = settings(plant__rate_hz=RATE_HZ, controller__rate_hz=RATE_HZ)
"""A fifth of the scenario's rate, to need less CPU time."""


PENDULUM = """
[model]
A = [[0.0, 1.0], [2.0, 0.0]]
B = [[0.0], [1.0]]
gain = [[-6.0, -3.0]]

[plant]
initial_state = [0.2, 0.0]
initial_state_halfwidth = [0.1, 0.1]
rate_hz = 50.0

[controller]
rate_hz = 50.0

[trigger]
policy = "periodic"
period_s = 0.1

[network]
mansd = 2
loss = { model = "bernoulli", probability = 0.3 }
"""
"""Tables of a loop for scenarios of several."""


def private_files(folder: Path) -> list[Path]:
    """Return the private files below a runtime directory."""
    return [path for path in (folder / f"noack-{os.getuid()}").rglob("*") if path.is_file()]


def run_scenario(runs: Path, *arguments: str) -> Finished:
    """Run the command in this process, which has its modules; it starts the run's processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", WITHOUT_VIEWER["PYTHONPATH"])
        patch.setattr("cosim.live.finalize._write_recording", lambda *_: None)
        result = invoke("run", "lane_following", "--json", "--runs", runs, *BARE, *arguments)
    return Finished(result.exit_code, json.loads(result.stdout), result.stderr, (runs / "latest").resolve())


class Running:
    """An active run."""

    def __init__(self, runs: Path, process: subprocess.Popen[str]) -> None:
        self.runs = runs
        self.process = process
        self._children: list[psutil.Process] = []

    def wait_started(self) -> None:
        """Wait until the loop has started; fail if the run ends before."""
        wait_for(lambda: (self.runs / "latest").exists() or self.process.poll() is not None)
        assert self.process.poll() is None, self.process.communicate()
        self._children = psutil.Process(self.process.pid).children(recursive=True)

    def wait_recording(self) -> None:
        """Wait until the recorder has stored rows of plant, sensor and controller."""
        self.wait_started()
        for table in ("plant_step", "sensor_measurement", "controller_step"):
            path = self.runs / "latest" / "spool" / f"{table}.recorder"
            wait_for(lambda path=path: path.exists() and path.stat().st_size > 10_000)

    def child(self, role: str) -> psutil.Process:
        """Return the process of a role, as of the start."""
        for child in self._children:
            if is_of(role, child):
                return child
        raise AssertionError(f"no process of {role}")

    def finish(self, patience_s: float = PATIENCE_S) -> Finished:
        """Wait for the end of the run."""
        stdout, stderr = self.process.communicate(timeout=patience_s)
        assert stdout, (self.process.returncode, stderr)
        summary = json.loads(stdout)
        return Finished(self.process.returncode, summary, stderr, (self.runs / "latest").resolve())

    def finish_unstarted(self) -> str:
        """Return the error of a run that never started."""
        stdout, _ = self.process.communicate(timeout=PATIENCE_S)
        assert self.process.returncode == 1
        return str(json.loads(stdout)["error"])

    def left_behind(self) -> list[psutil.Process]:
        """Return the processes of the run that do not end."""
        _, alive = psutil.wait_procs(self._children, timeout=PATIENCE_S)
        return [child for child in alive if not is_over(child)]


@contextmanager
def start_runs(folder: Path) -> Iterator[Callable[..., Running]]:
    """Start ``noack run`` in the background; kill remaining processes at the end."""
    with start_commands() as start:

        def begin(
            *arguments: str, command: tuple[str, ...] = ("run", "lane_following"), **more: Any
        ) -> Running:
            runs = folder / "runs"
            common = ("--json", "--runs", runs, *BARE)
            return Running(runs, start(*command, *common, *arguments, runtime=folder, **more))

        yield begin


def spooled(running: Running, table: str) -> Rows:
    """Return the rows of a table that are on disk."""
    spool = running.runs / "latest" / "spool"
    dtype = ResolvedRun(load(running.runs / "latest" / "scenario.toml")).tables[table]
    batches = [np.frombuffer(data, dtype) for _, data in read_batches(spool, table)]
    return np.concatenate([np.zeros(0, dtype), *batches])

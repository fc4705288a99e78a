"""Programs that benchmarks start: noack as a user starts it, C programs; on cores, on two hosts.

Runs are observed from outside, by their output and by samples of their processes.
"""

import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import psutil

from benchmarks.report import MeasurementError
from noack.protocol.roles import LOOP_ROLES
from tests.helpers.live_runs import is_over, processes_of, start_runs
from tests.helpers.waiting import PATIENCE_S

PROGRESS = re.compile(r"^([0-9.]+)/[0-9.e+]+ s\b")
"""A progress line of a run; the group is the time in the run, s."""
_ROUNDING_S = 0.05
"""Rounding error of a progress line, which shows tenths of a second."""
PLAIN_TERMINAL = {"FORCE_COLOR": "1", "TERM": "dumb"}
"""Makes noack treat a pipe as a simple terminal; other pipes receive no progress lines."""
FREE_PORTS = ("--set", "ports={}")
"""A benchmark can run at the same time as a demo, whose ports are fixed."""
NOACK = (sys.executable, "-m", "cosim.cli")
LAUNCHER = "launcher"
_Result = TypeVar("_Result")
_POLL_S = 0.1
_PATIENCE_RATIO = 6.0
"""A run and its end may take this multiple of the run's length."""
PRIORITY = 50
"""SCHED_FIFO priority of a run's processes, by default."""


def program_path(name: str, package: str) -> str:
    """Return the path of a program that a package of Debian has."""
    if (path := shutil.which(name)) is None:
        raise MeasurementError(f"{name} is not installed (Debian: apt-get install {package})")
    return path


def compile_program(source: str, into: Path, *options: str) -> Path:
    """Compile a C file of this folder into another folder; return the path."""
    target = into / Path(source).stem
    path = Path(__file__).with_name(source)
    command = [program_path("cc", "gcc"), "-O2", *options, "-o", str(target), str(path)]
    completed = subprocess.run(command, capture_output=True, text=True, check=False)
    if completed.returncode != 0:
        raise MeasurementError(f"cc {source}: {completed.stderr.strip()[:200]}")
    return target


class OutputLine(NamedTuple):
    """A line of a program's standard error, and the time at which it was read."""

    at_s: float
    text: str


class FinishedProgram(NamedTuple):
    """A program that has ended with exit status 0."""

    began_s: float
    lines: list[OutputLine]
    stdout: str


def execute(command: Sequence[str]) -> FinishedProgram:
    """Run a program to its end, recording the time of each line of its standard error."""
    with tempfile.TemporaryFile("w+") as stdout:
        began_s = time.monotonic()
        with subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | PLAIN_TERMINAL,
        ) as process:
            assert process.stderr is not None
            lines = [OutputLine(time.monotonic(), text.rstrip()) for text in process.stderr]
        stdout.seek(0)
        if process.returncode != 0:
            messages = [line.text for line in lines if not PROGRESS.match(line.text)]
            last = messages[-1] if messages else "no message"
            raise MeasurementError(f"{command[0]} ended with {process.returncode}: {last}")
        return FinishedProgram(began_s, lines, stdout.read())


def imported_s(modules: str) -> float:
    """Return wall seconds from the start of a Python to the end of its imports."""
    code = f"import {modules}, sys; print('ready', file=sys.stderr)"
    finished = execute([sys.executable, "-c", code])
    return finished.lines[-1].at_s - finished.began_s


def in_new_process(call: Callable[..., _Result], *arguments: object) -> _Result:
    """Return what a call returns in a process of its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(call, *arguments).result()


class NoackRun(NamedTuple):
    """A completed run of noack."""

    summary: dict[str, Any]
    first_step_s: float | None
    """Wall time from process start to the first control step (:func:`first_step_s`)."""


def noack(*arguments: str) -> NoackRun:
    """Run ``noack ARGUMENTS`` to its end and return its own measurements."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        finished = execute([*NOACK, *arguments, *FREE_PORTS, "--runs", runs, "--json"])
    return NoackRun(json.loads(finished.stdout), first_step_s(finished.began_s, finished.lines))


def first_step_s(began_s: float, lines: Iterable[OutputLine]) -> float | None:
    """Return an upper bound of the time from ``began_s`` to the first control step at speed 1.

    A progress line that shows simulated time t and is read at time s proves that the run's epoch
    was at s − t or before, up to the line's rounding: s − t is the epoch plus the line's delay,
    some hundredths of a second. The minimum over all lines is the best bound. The first control
    step is half a control period (1 ms) after the epoch, far less than the bound's slack. None if
    there was no progress line.
    """
    bounds_s = [
        line.at_s - (float(match[1]) - _ROUNDING_S) - began_s
        for line in lines
        if (match := PROGRESS.match(line.text)) is not None
    ]
    return min(bounds_s, default=None)


class Sample(NamedTuple):
    """The system's data about a process."""

    at_s: float
    """Monotonic clock."""
    rss_kib: float
    uss_kib: float
    """Private memory, which is checked; shared memory is no leak of this process."""
    fds: int
    sockets: int
    threads: int
    cpu_s: float

    @classmethod
    def of(cls, process: psutil.Process) -> "Sample":
        """Sample a process."""
        with process.oneshot():
            memory, cpu = process.memory_full_info(), process.cpu_times()
            return cls(
                time.monotonic(),
                memory.rss / 1024,
                memory.uss / 1024,
                process.num_fds(),
                len(process.net_connections("all")),
                process.num_threads(),
                cpu.user + cpu.system,
            )


class ObservedRun(NamedTuple):
    """A run of noack that has ended, observed from outside; times are of the monotonic clock."""

    summary: dict[str, Any]
    run_dir: Path
    samples: Mapping[str, list[Sample]]
    """By process, from the first rows of the loops to the end of the command."""
    began_s: float
    """The loops' first rows are recorded."""
    horizon_s: float
    """The loops have reached their horizon, or have ended before."""
    ended_s: float
    """The loops' processes have ended."""
    closed_s: float
    """The command has ended."""
    left_behind: list[str]
    """Processes that did not end with it."""

    def in_loops(self, role: str) -> list[Sample]:
        """The samples of a process while the loops ran, without their first and last seconds."""
        begin_s, end_s = self.began_s + 1, self.horizon_s - 2
        return [sample for sample in self.samples.get(role, ()) if begin_s <= sample.at_s <= end_s]


def observed_run(arguments: Sequence[str], folder: Path, length_s: float, pause_s: float) -> ObservedRun:
    """Run ``noack run ARGUMENTS`` to its end, and sample its processes.

    Args:
        arguments: scenario and options.
        folder: for the run directory.
        length_s: wall time of the loops.
        pause_s: time between two samples.
    """
    samples, closed = defaultdict[str, list[Sample]](list), threading.Event()
    began_s = ended_s = math.inf

    def observe() -> None:
        nonlocal ended_s
        sampled_s = -math.inf
        while not closed.wait(_POLL_S):
            now_s = time.monotonic()
            if not all(is_over(processes[role]) for role in LOOP_ROLES):
                ended_s = now_s
            if now_s > sampled_s + pause_s:
                sampled_s = now_s
                for role, process in processes.items():
                    with suppress(psutil.Error):
                        samples[role].append(Sample.of(process))

    with start_runs(folder) as begin:
        run = begin(command=("run", *arguments), viewer=True)
        run.wait_recording()
        began_s = time.monotonic()
        launcher = psutil.Process(run.process.pid)
        processes = processes_of(launcher) | {LAUNCHER: launcher}
        observer = threading.Thread(target=observe)
        observer.start()
        try:
            finished = run.finish(_PATIENCE_RATIO * length_s + PATIENCE_S)
        finally:
            closed_s = time.monotonic()
            closed.set()
            observer.join()
        left = [process.name() for process in run.left_behind()]
    horizon_s = min(ended_s, began_s + length_s)
    return ObservedRun(
        finished.summary, finished.run_dir, samples, began_s, horizon_s, ended_s, closed_s, left
    )


_CORES = sorted(os.sched_getaffinity(0))
RELAY_CORE, LOAD_CORE = _CORES[0], _CORES[-1]
"""Where relays run, and where their load does."""


@contextmanager
def on_core(core: int) -> Iterator[None]:
    """Pin the calling thread, and processes that it starts within the context, to one core."""
    previous_cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, previous_cores)


@contextmanager
def raise_priority(priority: int = 1) -> Iterator[bool]:
    """Apply SCHED_FIFO to the calling thread and the processes that it starts, if permitted.

    With the lowest priority other programs of the machine do not affect a comparison of relays.

    Yields:
        Whether it was permitted.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, policy, parameters)

"""Runs of noack that are observed from outside, by samples of their processes."""

import math
import threading
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from noack.protocol.roles import LOOP_ROLES
from tests.helpers.live_runs import is_over, processes_of, start_runs
from tests.helpers.waiting import PATIENCE_S

LAUNCHER = "launcher"
_POLL_S = 0.1
_PATIENCE_RATIO = 6.0
"""A run and its end may take this multiple of the run's length."""


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
            counts = process.num_fds(), len(process.net_connections("all")), process.num_threads()
            used_s = cpu.user + cpu.system
            return cls(time.monotonic(), memory.rss / 1024, memory.uss / 1024, *counts, used_s)


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

    def cpu_share(self, role: str) -> float:
        """Return a process's CPU time per wall time while the loops ran."""
        first, *_, last = self.in_loops(role)
        return (last.cpu_s - first.cpu_s) / (last.at_s - first.at_s)

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

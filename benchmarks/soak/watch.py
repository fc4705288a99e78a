"""Samples the processes of a run from outside."""

import contextlib
import os
from pathlib import Path
from typing import NamedTuple

import psutil

from noack.protocol.topology import ROLES

LAUNCHER = "launcher"


class Sample(NamedTuple):
    """The system's data about a process."""

    rss_kib: float
    pss_kib: float
    uss_kib: float
    """Private memory, which is judged; shared memory is no leak of this process."""
    fds: int
    sockets: int
    threads: int
    cpu_s: float


class Processes:
    """The launcher of a run and its processes.

    Args:
        launcher: process id of ``noack run``.
    """

    def __init__(self, launcher: int) -> None:
        self._known = {LAUNCHER: psutil.Process(launcher)}

    def sample(self) -> dict[str, Sample]:
        """Sample every process that is alive."""
        if len(self._known) <= len(ROLES):
            with contextlib.suppress(psutil.Error):
                children = self._known[LAUNCHER].children()
                named = {role: child for child in children for role in ROLES if is_of(role, child)}
                self._known = named | self._known
        found = {}
        for role, process in self._known.items():
            with contextlib.suppress(psutil.Error):
                found[role] = take_sample(process)
        return found

    def left_behind(self, patience_s: float) -> list[str]:
        """Return the roles of processes that are alive although the run is over."""
        _, alive = psutil.wait_procs(list(self._known.values()), timeout=patience_s)
        return sorted(role for role, process in self._known.items() if process in alive)

    def kill(self) -> None:
        """Kill all processes, the launcher last."""
        for process in reversed(self._known.values()):
            with contextlib.suppress(psutil.Error):
                process.kill()


def is_of(role: str, process: psutil.Process) -> bool:
    """Whether a process has a role in a run, by its title; not if it has ended."""
    try:
        return process.cmdline()[:1] == [f"noack {role}"]
    except psutil.NoSuchProcess:
        return False


def udp_port(process: psutil.Process) -> int:
    """Return the port of a process in the loop."""
    (port,) = {one.laddr.port for one in process.net_connections("udp4") if not one.raddr}
    return int(port)


def take_sample(process: psutil.Process) -> Sample:
    """Sample a process."""
    with process.oneshot():
        memory = process.memory_full_info()
        cpu = process.cpu_times()
        threads = process.num_threads()
    pss = getattr(memory, "pss", memory.uss)
    return Sample(
        memory.rss / 1024, pss / 1024, memory.uss / 1024, process.num_fds(),
        len(process.net_connections("all")), threads, cpu.user + cpu.system,
    )  # fmt: skip


def size_bytes(folder: Path) -> int:
    """Return a folder's size on the disk; files and folders may vanish meanwhile."""
    total = 0
    for inner, _, names in os.walk(folder):  # os.walk skips folders that it cannot read
        for name in names:
            with contextlib.suppress(OSError):
                total += (Path(inner) / name).stat().st_blocks * 512
    return total

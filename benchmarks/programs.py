"""Programs that benchmarks start: noack as a user starts it, C programs; on cores, on two hosts.

Runs are observed from outside, by their output and by samples of their processes.
"""

import contextlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from benchmarks.report import MeasurementError
from cosim.record.run_directory import LATEST
from noack.protocol.topology import LOOP_ROLES, ROLES
from noack.runtime.spool import SPOOL

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
_LOOK_S = 0.1
_START_PATIENCE_S, _EXIT_PATIENCE_S = 300.0, 10.0
_END_PATIENCE = 6.0
"""A run and its end may take this multiple of the run's length."""
PRIORITY = 50
"""SCHED_FIFO priority of a run's processes, by default."""


def program_path(name: str, package: str) -> str:
    """Return the path of a program that a package of Debian has."""
    if (path := shutil.which(name)) is None:
        raise MeasurementError(f"{name} is not installed (Debian: apt-get install {package})")
    return path


def compiled(source: str, into: Path, *options: str) -> Path:
    """Compile a C file of this folder into another folder; return the path."""
    target = into / Path(source).stem
    path = Path(__file__).with_name(source)
    command = [program_path("cc", "gcc"), "-O2", *options, "-o", str(target), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise MeasurementError(f"cc {source}: {done.stderr.strip()[:200]}")
    return target


class Line(NamedTuple):
    """A line of a program's standard error, and the time at which it was read."""

    at_s: float
    text: str


class Finished(NamedTuple):
    """A program that has ended with exit status 0."""

    begun_s: float
    lines: list[Line]
    stdout: str


def execute(command: Sequence[str]) -> Finished:
    """Run a program to its end, recording the time of each line of its standard error."""
    with tempfile.TemporaryFile("w+") as stdout:
        begun_s = time.monotonic()
        with subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | PLAIN_TERMINAL,
        ) as process:
            assert process.stderr is not None
            lines = [Line(time.monotonic(), text.rstrip()) for text in process.stderr]
        stdout.seek(0)
        if process.returncode != 0:
            messages = [line.text for line in lines if not PROGRESS.match(line.text)]
            last = messages[-1] if messages else "no message"
            raise MeasurementError(f"{command[0]} ended with {process.returncode}: {last}")
        return Finished(begun_s, lines, stdout.read())


def imported_s(modules: str) -> float:
    """Return wall seconds from the start of a Python to the end of its imports."""
    code = f"import {modules}, sys; print('ready', file=sys.stderr)"
    finished = execute([sys.executable, "-c", code])
    return finished.lines[-1].at_s - finished.begun_s


class NoackRun(NamedTuple):
    """A completed run of noack."""

    summary: dict[str, Any]
    first_step_s: float | None
    """Wall time from process start to the first control step (:func:`first_step_s`)."""


def noack(*arguments: str) -> NoackRun:
    """Run ``noack ARGUMENTS`` to its end and return its own measurements."""
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as runs:
        finished = execute([*NOACK, *arguments, *FREE_PORTS, "--runs", runs, "--json"])
    return NoackRun(json.loads(finished.stdout), first_step_s(finished.begun_s, finished.lines))


def first_step_s(begun_s: float, lines: Iterable[Line]) -> float | None:
    """Return an upper bound of the time from ``begun_s`` to the first control step at speed 1.

    A progress line that shows simulated time t and is read at time s proves that the run's epoch
    was at s − t or before, up to the line's rounding: s − t is the epoch plus the line's delay,
    some hundredths of a second. The minimum over all lines is the best bound. The first control
    step is half a control period (1 ms) after the epoch, far less than the bound's slack. None if
    there was no progress line.
    """
    bounds_s = [
        line.at_s - (float(match[1]) - _ROUNDING_S) - begun_s
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
    """Private memory, which is judged; shared memory is no leak of this process."""
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


class Processes:
    """The launcher of a run, by its process id, and the run's processes."""

    def __init__(self, launcher: int) -> None:
        self._known = {LAUNCHER: psutil.Process(launcher)}

    def sample(self) -> dict[str, Sample]:
        """Sample every process that is alive."""
        if len(self._known) <= len(ROLES):
            with contextlib.suppress(psutil.Error):
                self._known = processes_of(self._known[LAUNCHER]) | self._known
        samples = {}
        for role, process in self._known.items():
            with contextlib.suppress(psutil.Error):
                samples[role] = Sample.of(process)
        return samples

    def are_alive(self, roles: Sequence[str]) -> bool:
        """Whether a process of these roles, once seen by :meth:`sample`, has not ended."""
        ended = (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
        for role in roles:
            with contextlib.suppress(KeyError, psutil.Error):
                if self._known[role].status() not in ended:
                    return True
        return False

    def left_behind(self, patience_s: float) -> list[str]:
        """Return the roles of processes that are alive although the run is over."""
        _, alive = psutil.wait_procs(list(self._known.values()), timeout=patience_s)
        return sorted(role for role, process in self._known.items() if process in alive)

    def kill(self) -> None:
        """Kill all processes, the launcher last."""
        for process in reversed(self._known.values()):
            with contextlib.suppress(psutil.Error):
                process.kill()


class Observed(NamedTuple):
    """A run of noack that has ended, observed from outside; times are of the monotonic clock."""

    summary: dict[str, Any]
    run_dir: Path
    samples: Mapping[str, list[Sample]]
    """By process, from the loops' start to the end of the command."""
    begun_s: float
    """The loops' start, up to the start of the recording."""
    ended_s: float
    """The loops' end."""
    horizon_s: float
    """Then or before: the loops had reached their horizon."""
    closed_s: float
    """The end of the command."""
    left_behind: list[str]
    """Processes that were alive 10 s later."""

    def in_loops(self, role: str) -> list[Sample]:
        """The samples of a process while the loops ran, without their first and last second."""
        return [
            sample
            for sample in self.samples.get(role, ())
            if self.begun_s + 1 <= sample.at_s <= self.horizon_s - 1
        ]


def observed_run(arguments: Sequence[str], runs: Path, length_s: float, pause_s: float) -> Observed:
    """Run ``noack run ARGUMENTS`` as a user does, and sample its processes.

    Args:
        arguments: scenario and options.
        runs: the folder for the run directory, and for what the command prints.
        length_s: wall time of the loops.
        pause_s: time between two samples.

    Raises:
        MeasurementError: the run did not begin, or did not end in time.
    """
    latest, printed, messages = runs / LATEST, runs / "summary.json", runs / "messages.txt"
    command = [*NOACK, "run", *arguments, "--json", "--runs", str(runs)]
    samples = defaultdict[str, list[Sample]](list)
    with (
        printed.open("w") as stdout,
        messages.open("w") as stderr,
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr) as process,
    ):
        processes = Processes(process.pid)
        begun_s = ended_s = sampled_s = math.inf
        limit_s = time.monotonic() + _START_PATIENCE_S
        while process.poll() is None:
            now_s = time.monotonic()
            if begun_s == math.inf and (latest / SPOOL).is_dir():
                begun_s = sampled_s = now_s
                limit_s = now_s + _END_PATIENCE * length_s + _START_PATIENCE_S
            if now_s >= sampled_s:
                sampled_s = now_s + pause_s
                for role, sample in processes.sample().items():
                    samples[role].append(sample)
            if processes.are_alive(LOOP_ROLES):
                ended_s = now_s
            if now_s > limit_s:
                processes.kill()
                raise MeasurementError("the run did not begin, or did not end in time")
            time.sleep(_LOOK_S)
        closed_s = time.monotonic()
    if ended_s == math.inf or not printed.stat().st_size:
        lines = messages.read_text(errors="replace").strip().splitlines() or ["no message"]
        raise MeasurementError(f"the run has no summary: {lines[-1]}")
    left_behind = processes.left_behind(_EXIT_PATIENCE_S)
    processes.kill()
    return Observed(
        json.loads(printed.read_text()),
        latest.resolve(),
        samples,
        begun_s,
        ended_s,
        min(ended_s, begun_s + length_s),
        closed_s,
        left_behind,
    )


def processes_of(launcher: psutil.Process) -> dict[str, psutil.Process]:
    """Return the processes of a run by role."""
    children = launcher.children()
    return {role: child for child in children for role in ROLES if is_of(role, child)}


def is_of(role: str, process: psutil.Process) -> bool:
    """Whether a process has a role in a run, by its title; not if it has ended."""
    try:
        return bool(process.cmdline()[:1] == [f"noack {role}"])
    except psutil.NoSuchProcess:
        return False


def udp_port(process: psutil.Process) -> int:
    """Return the port of a process in the loop."""
    (port,) = {udp.laddr.port for udp in process.net_connections("udp4") if not udp.raddr}
    return int(port)


_CORES = sorted(os.sched_getaffinity(0))
RELAY_CORE, LOAD_CORE = _CORES[0], _CORES[-1]
BEFORE_OTHERS = 1
"""The lowest SCHED_FIFO priority. If permitted, the load and all relays have it, so that other
programs of the machine do not affect their comparison."""


@contextmanager
def on_core(core: int) -> Iterator[None]:
    """Pin the calling thread, and processes that it starts within the context, to one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def scheduled(priority: int) -> Iterator[bool]:
    """Apply SCHED_FIFO to the calling thread and the processes that it starts, if permitted.

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


class TwoHosts(NamedTuple):
    """Two network namespaces that a veth link connects: their names, addresses IPv4 and IPv6."""

    names: tuple[str, str]
    addresses: tuple[tuple[str, str], tuple[str, str]]

    def inside(self, host: int, *command: str, monotonic_s: int = 0) -> list[str]:
        """Return a command that runs on a host, whose monotonic clock is ahead by some seconds."""
        clock = ["unshare", "--time", f"--monotonic={monotonic_s}", "--fork", "--kill-child"]
        return ["ip", "netns", "exec", self.names[host], *(clock if monotonic_s else ()), *command]


def _run(command: Sequence[str]) -> None:
    try:
        subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    except subprocess.CalledProcessError as error:
        raise MeasurementError(f"{' '.join(command)}: {error.stderr.strip()}") from None


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Make the namespaces, and delete them at the end."""
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        raise MeasurementError("ip (iproute2) and unshare (util-linux) are not installed")
    names = (f"noack-{os.getpid()}-reference", f"noack-{os.getpid()}-client")
    hosts = TwoHosts(names, (("10.83.3.1", "fd83:3::1"), ("10.83.3.2", "fd83:3::2")))
    try:
        for name in names:
            _run(["ip", "netns", "add", name])
            _run(["ip", "-n", name, "link", "set", "lo", "up"])
        _run(["ip", "-n", names[0], "link", "add", "line", "type", "veth", "peer", "line", "netns", names[1]])
        for name, (four, six) in zip(names, hosts.addresses, strict=True):
            _run(["ip", "-n", name, "address", "add", f"{four}/24", "dev", "line"])
            _run(["ip", "-n", name, "address", "add", f"{six}/64", "dev", "line", "nodad"])
            _run(["ip", "-n", name, "link", "set", "line", "up"])
        _run(hosts.inside(1, "true", monotonic_s=1))
        yield hosts
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)

"""Measures a machine in a few seconds, with the sockets, timers and settings of a run.

The measurements stand beside what a scenario requires (:class:`RunRequirements`).
"""

import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict, TypeVar

import numpy as np
import zenoh

from cosim.live.disk_space import needed_bytes
from cosim.output.viewer.rerun_program import has_display, is_installed
from cosim.record.run_directory import environment
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, MachineError, NoackError, one_line, why
from netem.core.private_folder import open_private
from netem.core.system_processes import python_command
from noack.runtime.active_runs import RUNS
from noack.runtime.connections.zenoh_session import answer_to, cause_of, open_session
from noack.runtime.counting_sockets import bind
from noack.scenario.resolution import ResolvedRun
from noack.scenario.scenario import Scenario

T = TypeVar("T")
_DATAGRAM = bytes(72)
_FLOOD_DATAGRAMS = 20_000
_WRITE_BYTES = 32 * 1024 * 1024
_PROBE_TIMEOUT_S = 20.0
_QUERY_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class RunRequirements:
    """What a scenario requires of the machine; times are wall time."""

    name: str
    duration_s: float
    period_ns: int
    """Period of the plant's steps."""
    allowance_ns: int
    """Lateness of updates and inputs that the certificates allow."""
    realtime: bool
    """Whether the scenario asks for real-time settings."""
    fifo_priority: int
    spin_us: float
    ports: Mapping[str, int]
    """Ports by key, without ports that are 0 (any free port)."""

    @property
    def rate_hz(self) -> float:
        """Steps of the plant per wall second."""
        return NS_PER_S / self.period_ns


def requirements_of(resolved: Scenario) -> RunRequirements:
    """Return what a resolved scenario requires of the machine."""
    period_ns = round(resolved.timing.plant_period_ns / resolved.speed)
    return RunRequirements(
        name=resolved.name,
        duration_s=resolved.horizon_s / resolved.speed,
        period_ns=period_ns,
        allowance_ns=resolved.certificate.late_periods * period_ns,
        realtime=resolved.realtime.enabled,
        fifo_priority=resolved.realtime.fifo_priority,
        spin_us=resolved.realtime.spin_us,
        ports={name: port for name, port in resolved.ports.model_dump().items() if port},
    )


@dataclass(frozen=True)
class Lateness:
    """Lateness of an idle loop that wakes up at the plant's rate."""

    wakes: int
    p50_us: float
    p99_us: float
    max_us: float
    too_late: int
    """Number of wake-ups that were later than the certificates allow."""


@dataclass(frozen=True)
class Buffer:
    """The receive buffer of a run's sockets."""

    datagrams: int
    """Number of a run's datagrams that it holds."""
    buffer_bytes: int
    most_bytes: int | None
    """Largest size without privileges; None if unknown."""


@dataclass(frozen=True)
class Disk:
    """The folder of the run directories."""

    folder: str
    free_bytes: int
    needed_bytes: int
    """Space for the run's rows until the run has ended."""
    write_bytes_per_s: float


@dataclass(frozen=True)
class MachineFacts:
    """All measurements. A failed measurement is one line with the reason."""

    cores: int
    """Cores that this process may use."""
    cores_online: int
    load: float | None
    """Load average over the last minute."""
    governor: str | None
    """Frequency governor of the first core; None if unknown."""
    settings: Mapping[str, str]
    """For each real-time setting: applied or not permitted, as ``realtime`` reports it."""
    lateness: Lateness | str
    """Of wake-ups, with the real-time settings if the scenario asks for them."""
    buffer: Buffer | str
    ports_taken: Sequence[str]
    """A line for each port of the scenario that is in use."""
    control: float | str
    """Seconds per query over the control plane (zenoh, over a Unix socket)."""
    disk: Disk | str
    runtime_folder: str | None
    """Why the folder for the user's private files cannot be used; None if it can."""
    display: bool
    viewer: str | None
    """Version of rerun; None if it cannot be imported."""


def measure(resolved: Scenario, required: RunRequirements, runs: Path, duration_s: float) -> MachineFacts:
    """Measure this machine for a scenario.

    Args:
        resolved: the resolved scenario.
        required: its requirements.
        runs: folder of the run directories; it need not exist.
        duration_s: length of the measurement of wake-ups.
    """
    late, settings = _measure_wake_ups(required, duration_s)
    recorded = environment("live")
    return MachineFacts(
        cores=recorded["cores"],
        cores_online=os.cpu_count() or 1,
        load=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        governor=_read(Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")),
        settings=settings,
        lateness=late,
        buffer=_result_or_reason(_measure_buffer),
        ports_taken=list(_list_taken_ports(required)),
        control=_result_or_reason(_measure_query),
        disk=_result_or_reason(lambda: _measure_disk(runs, needed_bytes(ResolvedRun(resolved).step_bytes))),
        runtime_folder=_runtime_folder_problem(),
        display=has_display(),
        viewer=recorded["packages"].get("rerun-sdk") if is_installed() else None,
    )


def _result_or_reason(measure_it: Callable[[], T]) -> T | str:
    try:
        return measure_it()
    except NoackError as error:
        return str(error)
    except zenoh.ZError as error:
        return cause_of(error)
    except OSError as error:
        return why(error)


class _WakeUps(TypedDict):
    """What the probe prints: lateness in ns, and whether each setting was applied."""

    late_ns: list[int]
    settings: dict[str, str]


def _measure_wake_ups(required: RunRequirements, duration_s: float) -> tuple[Lateness | str, dict[str, str]]:
    arguments = (
        required.period_ns, duration_s, required.fifo_priority, required.spin_us, int(required.realtime)
    )  # fmt: skip
    command = python_command("-m", "cosim.doctor.probe", *arguments)
    try:
        probe = subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=_PROBE_TIMEOUT_S + 10 * duration_s
        )
    except (OSError, subprocess.SubprocessError) as error:
        return one_line(error), {}
    printed: _WakeUps = json.loads(probe.stdout)
    return lateness(printed["late_ns"], required.allowance_ns), printed["settings"]


def lateness(late_ns: Iterable[int], allowance_ns: int) -> Lateness | str:
    """Return the statistics of lateness in ns, or one line with the reason why there are none."""
    late = np.array(list(late_ns), dtype=np.int64)
    if not len(late):
        return "no wake-up was measured"
    p50, p99 = np.quantile(late, [0.5, 0.99]) / 1e3
    too_late = int((late > allowance_ns).sum())
    return Lateness(len(late), float(p50), float(p99), float(late.max()) / 1e3, too_late)


def _measure_buffer() -> Buffer:
    with closing(bind(0, "nothing")) as endpoint, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(endpoint.getsockname())
        for _ in range(_FLOOD_DATAGRAMS):
            sender.send(_DATAGRAM)
        received = 0
        with suppress(BlockingIOError):
            while received < _FLOOD_DATAGRAMS:
                endpoint.recv(len(_DATAGRAM) + 1)
                received += 1
        buffer_bytes = endpoint.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    limit = _read(Path("/proc/sys/net/core/rmem_max"))
    return Buffer(received, buffer_bytes, int(limit) if limit else None)


def _list_taken_ports(required: RunRequirements) -> Iterable[str]:
    for name, port in required.ports.items():
        try:
            bind(port, f"ports.{name}").close()
        except CallerError as error:
            yield str(error)


def _measure_query() -> float:
    """Return the time of a query in seconds, over zenoh sessions as in the control plane."""
    name, key = f"doctor-{os.getpid()}", "noack/doctor"
    with (
        open_session(RUNS, name, listen=True) as centre,
        centre.declare_queryable(key, lambda query: query.reply(key, "here")),
        open_session(RUNS, name, listen=False) as client,
    ):
        began_s = time.perf_counter()
        answer = answer_to(client, key, "", _QUERY_TIMEOUT_S)
        taken_s = time.perf_counter() - began_s
    if answer is None:
        raise MachineError(f"no answer within {_QUERY_TIMEOUT_S:g} s")
    return taken_s


def _measure_disk(runs: Path, required_bytes: int) -> Disk:
    folder = next(path for path in (runs, *runs.absolute().parents) if path.is_dir())
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            block = bytes(1024 * 1024)
            began_s = time.perf_counter()
            for _ in range(_WRITE_BYTES // len(block)):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
            taken_s = time.perf_counter() - began_s
    except OSError as error:
        raise MachineError(f"{folder}: cannot be written: {why(error)}") from None
    return Disk(str(folder), shutil.disk_usage(folder).free, required_bytes, _WRITE_BYTES / taken_s)


def _runtime_folder_problem() -> str | None:
    try:
        with open_private(create=True):
            pass
    except CallerError as error:
        return str(error)
    return None


def _read(path: Path) -> str | None:
    try:
        return path.read_text().strip() or None
    except OSError:
        return None

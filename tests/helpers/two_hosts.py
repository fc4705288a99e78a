"""Two hosts for tests and benchmarks: network namespaces that a link connects (needs root); clocks."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from noack.core.errors import MachineError
from noack.runtime.host_clocks.time_exchange import HostClocks

_CLONE_NEWNET = 0x40000000


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
        raise MachineError(f"{' '.join(command)}: {error.stderr.strip()}") from None


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Make the namespaces, and delete them at the end."""
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        raise MachineError("ip (iproute2) and unshare (util-linux) are not installed")
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


def enter_namespace(namespace: str) -> None:
    """Move this thread to a network namespace."""
    with Path(f"/var/run/netns/{namespace}").open() as file:
        if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns failed")


class DrivenClocks(HostClocks):
    """The clocks of this host, with an added offset and drift of the monotonic clock.

    Kernel stamps and the real-time clock have the same drift, as the clocks of a real host have.
    """

    def __init__(self, offset_ns: int = 0, drift_ppb: int = 0) -> None:
        self._begin_ns = super().monotonic_ns()
        self._real_begin_ns = super().realtime_ns()
        self._offset_ns = offset_ns
        self._drift_ppb = drift_ppb

    def added_ns(self, true_ns: int) -> int:
        """What is added to the monotonic clock at its own reading ``true_ns``."""
        return self._offset_ns + self._drift_ppb * (true_ns - self._begin_ns) // 10**9

    def monotonic_ns(self) -> int:
        """The monotonic clock, with offset and drift."""
        true_ns = super().monotonic_ns()
        return true_ns + self.added_ns(true_ns)

    def realtime_ns(self) -> int:
        """The real-time clock, with the drift."""
        return self._drifted(super().realtime_ns())

    def stamp_ns(self, stamp: bytes) -> int:
        """The time of a kernel stamp, with the drift."""
        return self._drifted(super().stamp_ns(stamp))

    def _drifted(self, real_ns: int) -> int:
        return real_ns + self._drift_ppb * (real_ns - self._real_begin_ns) // 10**9

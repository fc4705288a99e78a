"""Two hosts for tests and benchmarks: network namespaces that a link connects (needs root)."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from netem.core.errors import MachineError

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

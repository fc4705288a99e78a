"""Emulator and server in two network namespaces, with a slow line between them."""

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from noack.core.errors import ExitStatus
from tests.netem.programs.conftest import Emulate

COUNTER = Path(__file__).with_name("counter.py")
EMULATOR, SERVER = (f"noack-{os.getpid()}-{role}" for role in ("emulator", "server"))
HOSTS = {4: ("10.83.2.2/24", "10.83.2.1/24"), 6: ("fd83:2::2/64", "fd83:2::1/64")}
"""Addresses of the emulator and of the server, by version of IP."""
LOOPBACK = {4: "127.0.0.1", 6: "::1"}
SLOW_LINE = ("tbf", "rate", "800kbit", "burst", "40kb", "limit", "40kb")
"""Its queue is smaller than the number of packets that arrive within milliseconds.

The burst is larger than any segmented message: else tbf would segment the message itself, and lose
segments without an error.
"""
MANY = 400
QUEUE_FULL = os.strerror(errno.ENOBUFS)


def inside(name: str, *command: str) -> list[str]:
    """Return a command that runs in a namespace."""
    return ["ip", "netns", "exec", name, *command]


def run(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


def make_namespaces() -> None:
    for name in (EMULATOR, SERVER):
        run("ip", "netns", "add", name)
        run("ip", "-n", name, "link", "set", "lo", "up")
    run("ip", "-n", EMULATOR, "link", "add", "line", "type", "veth", "peer", "line",
        "netns", SERVER)  # fmt: skip
    for k, name in enumerate((EMULATOR, SERVER)):
        run("ip", "-n", name, "address", "add", HOSTS[4][k], "dev", "line")
        run("ip", "-n", name, "address", "add", HOSTS[6][k], "dev", "line", "nodad")
        run("ip", "-n", name, "link", "set", "line", "up")
    run(*inside(EMULATOR, "tc", "qdisc", "add", "dev", "line", "root", *SLOW_LINE))


@pytest.fixture(scope="module")
def _namespaces() -> Iterator[None]:
    if shutil.which("ip") is None or shutil.which("tc") is None:
        pytest.skip("ip and tc (iproute2) are not installed")
    try:
        make_namespaces()
        yield
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no network namespaces here: {error.stderr.strip()}")
    finally:
        for name in (EMULATOR, SERVER):
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


def url(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def queued() -> int:
    """Return the number of packets in the slow line."""
    show = run(*inside(EMULATOR, "tc", "-s", "-j", "qdisc", "show", "dev", "line"))
    return int(json.loads(show)[0]["qlen"])


def unread(version: int, port: int) -> int:
    """Return the number of received bytes that the emulator has not read yet from a port."""
    rows = run(*inside(EMULATOR, "cat", "/proc/net/udp" if version == 4 else "/proc/net/udp6"))
    for row in rows.splitlines()[1:]:
        _, local, _, _, queues, *_ = row.split()
        if int(local.rpartition(":")[2], 16) == port:
            return int(queues.partition(":")[2], 16)
    raise AssertionError(rows)


@pytest.mark.usefixtures("_namespaces")
@pytest.mark.parametrize(("version", "options"), [(4, ["--segment"]), (6, ["--one-way"])])
def test_packets_refused_by_a_full_output_queue_are_counted(
    emulate: Emulate, version: int, options: Sequence[str]
) -> None:
    """Every datagram is in one counter, and the emulator does not claim the guarantee."""
    here, server = LOOPBACK[version], HOSTS[version][1].partition("/")[0]
    with subprocess.Popen(
        inside(SERVER, sys.executable, str(COUNTER), "count", server),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as counting:  # fmt: skip
        try:
            assert counting.stdout is not None
            emulator = emulate(
                url(server, int(counting.stdout.readline())), "loss 20% mansd 2", *options,
                listen=url(here, 0), inside=inside(EMULATOR),
            )  # fmt: skip
            port = str(emulator.port)
            run(*inside(EMULATOR, sys.executable, str(COUNTER), "send", here, port, str(MANY)))
            while unread(version, emulator.port):
                time.sleep(0.02)
            link, status, stderr = emulator.end()
            while queued():
                time.sleep(0.02)
            printed, _ = counting.communicate(timeout=60)
        finally:
            counting.kill()
    forward = link["forward"]
    kernel, queue = (forward["unintended"][key] for key in ("lost_in_kernel", QUEUE_FULL))
    assert forward["received"] + kernel == MANY
    assert forward["forwarded"] == int(printed) + queue
    assert queue > 0
    assert "queue on the way out was full" in stderr
    assert status == ExitStatus.UNINTENDED_LOSSES

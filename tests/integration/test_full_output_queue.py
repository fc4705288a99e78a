"""A relay before a line between two hosts that is slower than the packets arrive."""

import errno
import json
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from netem.core.address import address_text
from netem.core.errors import ExitStatus, MachineError
from netem.core.udp_sockets import enlarge_buffer
from tests.attacks.attacked import unread_bytes
from tests.helpers.emulators import Emulate
from tests.helpers.two_hosts import TwoHosts, enter_namespace, two_hosts
from tests.helpers.waiting import wait_for

pytestmark = [pytest.mark.live, pytest.mark.system]

SLOW_LINE = ("tbf", "rate", "800kbit", "burst", "40kb", "limit", "40kb")
"""Its queue is smaller than the number of packets that arrive within milliseconds.

The burst is larger than any segmented message: else tbf would segment the message itself, and lose
segments without an error.
"""
MANY = 400
QUEUE_FULL = os.strerror(errno.ENOBUFS)


@pytest.fixture(scope="module")
def hosts() -> Iterator[TwoHosts]:
    if shutil.which("tc") is None:
        pytest.skip("tc (iproute2) is not installed")
    try:
        with two_hosts() as hosts:
            run(hosts, "tc", "qdisc", "add", "dev", "line", "root", *SLOW_LINE)
            yield hosts
    except MachineError as error:
        pytest.skip(f"no network namespaces here: {error}")


def run(hosts: TwoHosts, *command: str) -> str:
    done = subprocess.run(hosts.inside(0, *command), capture_output=True, check=True, timeout=60)
    return done.stdout.decode()


def queue_length(hosts: TwoHosts) -> int:
    """Return the number of packets that wait for the line."""
    return int(json.loads(run(hosts, "tc", "-s", "-j", "qdisc", "show", "dev", "line"))[0]["qlen"])


def bound_in(namespace: str, address: str) -> socket.socket:
    """Return a bound socket in a network namespace, which a thread enters for this."""

    def bound() -> socket.socket:
        enter_namespace(namespace)
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        endpoint = socket.socket(family, socket.SOCK_DGRAM)
        endpoint.bind((address, 0))
        enlarge_buffer(endpoint)
        return endpoint

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(bound).result()


@pytest.mark.parametrize(("version", "options"), [(0, ["--segment"]), (1, ["--one-way"])])
def test_packets_refused_by_a_full_output_queue_are_counted(
    emulate: Emulate, hosts: TwoHosts, version: int, options: Sequence[str]
) -> None:
    """Every datagram is in one counter, and the emulator does not claim the guarantee."""
    here, there = ("127.0.0.1", "::1")[version], hosts.addresses[1][version]
    with bound_in(hosts.names[1], there) as server, bound_in(hosts.names[0], here) as client:
        to, listen = address_text((there, server.getsockname()[1])), address_text((here, 0))
        words = ("loss 20% mansd 2", *options)
        emulator = emulate(to, *words, listen=listen, inside=hosts.inside(0))
        for _ in range(MANY):
            client.sendto(bytes(500), (here, emulator.port))
        wait_for(lambda: not unread_bytes(emulator.process.pid)[emulator.port])
        link, status, stderr = emulator.end()
        wait_for(lambda: not queue_length(hosts))
        server.settimeout(0.3)  # longer than the last datagram travels after the queue
        received = 0
        with suppress(TimeoutError):
            while server.recv(2048):
                received += 1
    forward = link["forward"]
    kernel, queue = (forward["unintended"][key] for key in ("lost_in_kernel", QUEUE_FULL))
    assert forward["received"] + kernel == MANY
    assert forward["forwarded"] == received + queue
    assert queue > 0
    assert "queue on the way out was full" in stderr
    assert status == ExitStatus.UNINTENDED_LOSSES

"""Client, emulator and server in three network namespaces with separate addresses.

Without IP forwarding, packets reach the server only through the emulator.
"""

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import pytest

from noack.core.errors import ExitStatus
from noack.protocol.record_tables import Fate
from tests.netem.programs.conftest import Emulate
from tests.netem.programs.emulator import LET_OUT

ECHO = Path(__file__).with_name("echo.py")
COUNT = 20
CLIENT_PORT = 5000
ROLES = ("client", "emulator", "server")


class Side(NamedTuple):
    """Addresses of the network between two namespaces, by IP version."""

    clients: Sequence[str]
    """Two addresses of the side that sends first."""
    servers: str


OUTER = {
    4: Side(("10.83.1.2", "10.83.1.3"), "10.83.1.1"),
    6: Side(("fd83:1::2", "fd83:1::3"), "fd83:1::1"),
}
INNER = {4: Side(("10.83.2.2",), "10.83.2.1"), 6: Side(("fd83:2::2",), "fd83:2::1")}
WIDTH = {4: 24, 6: 64}


class Namespaces:
    """Three namespaces in a line, connected by two pairs of devices."""

    def __init__(self) -> None:
        self._names = {role: f"noack-{os.getpid()}-{role}" for role in ROLES}

    def inside(self, role: str) -> tuple[str, ...]:
        """Return the command prefix that runs a command in a namespace."""
        return ("ip", "netns", "exec", self._names[role])

    def make(self) -> None:
        for name in self._names.values():
            _ip("netns", "add", name)
            _ip("-n", name, "link", "set", "lo", "up")
        for networks, device, here, there in (
            (OUTER, "outer", "client", "emulator"),
            (INNER, "inner", "emulator", "server"),
        ):
            ends = (self._names[here], self._names[there])
            _ip(
                "-n", ends[0], "link", "add", device, "type", "veth",
                "peer", "name", device, "netns", ends[1],
            )  # fmt: skip
            for version, side in networks.items():
                for address in side.clients:
                    _add_address(ends[0], device, version, address)
                _add_address(ends[1], device, version, side.servers)
            for end in ends:
                _ip("-n", end, "link", "set", device, "up")

    def remove(self) -> None:
        for name in self._names.values():
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], capture_output=True, text=True, check=True)


def _add_address(name: str, device: str, version: int, address: str) -> None:
    at_once = ("nodad",) if version == 6 else ()
    _ip("-n", name, "address", "add", f"{address}/{WIDTH[version]}", "dev", device, *at_once)


@pytest.fixture(scope="module")
def namespaces() -> Iterator[Namespaces]:
    if shutil.which("ip") is None:
        pytest.skip("ip (iproute2) is not installed")
    made = Namespaces()
    try:
        try:
            made.make()
        except subprocess.CalledProcessError as error:
            pytest.skip(f"no network namespaces here: {error.stderr.strip()}")
        yield made
    finally:
        made.remove()


def url(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


@pytest.mark.parametrize(("here", "there"), [(4, 6), (6, 4)])
def test_each_client_address_is_a_flow_with_a_reverse_direction(
    namespaces: Namespaces, emulate: Emulate, here: int, there: int
) -> None:
    outer, inner = OUTER[here], INNER[there]
    serving = subprocess.Popen(
        [*namespaces.inside("server"), sys.executable, str(ECHO), "serve", inner.servers],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert serving.stdout is not None
        port = int(serving.stdout.readline())
        emulator = emulate(
            url(inner.servers, port), "--both", "loss 30% mansd 2",
            listen=url(outer.servers, 0), inside=namespaces.inside("emulator"),
        )  # fmt: skip

        def ask(address: str) -> list[str]:
            done = subprocess.run(
                [
                    *namespaces.inside("client"), sys.executable, str(ECHO), "ask",
                    outer.servers, str(emulator.port), address, str(CLIENT_PORT), str(COUNT),
                ],
                stdout=subprocess.PIPE, text=True, check=True, timeout=60,
            )  # fmt: skip
            return list(json.loads(done.stdout))

        with ThreadPoolExecutor() as threads:
            came = dict(zip(outer.clients, threads.map(ask, outer.clients), strict=True))
        link = emulator.finish()
    finally:
        serving.kill()
        said, _ = serving.communicate()
    seen = [tuple(json.loads(line)) for line in said.splitlines()]

    flows = {flow["client"]: flow for flow in link["forward"]["flows"]}
    assert flows.keys() == {url(address, CLIENT_PORT) for address in outer.clients}
    assert link["clients_ever"] == len(outer.clients)
    ports = set()
    for address in outer.clients:
        flow = flows[url(address, CLIENT_PORT)]
        assert flow["packets"] == COUNT
        there_fates = [row["fate"] for row in emulator.fates("forward", flow["flow"])]
        back_fates = [row["fate"] for row in emulator.fates("reverse", flow["flow"])]
        passed = [f"{address} {n}" for n, fate in enumerate(there_fates) if fate in LET_OUT]
        of_server = [one for one in seen if one[2].startswith(f"{address} ")]
        # The server receives the forwarded datagrams from the emulator, one port per client.
        assert [text for _, _, text in of_server] == passed
        sources = {(host, port) for host, port, _ in of_server}
        assert len(sources) == 1
        ((host, port),) = sources
        assert host == inner.clients[0]
        ports.add(port)
        assert came[address] == [
            text for text, fate in zip(passed, back_fates, strict=True) if fate in LET_OUT
        ]
        assert Fate.DROPPED in there_fates
        assert flow["longest_loss_burst"] <= 2
    assert len(ports) == len(outer.clients)
    assert len(seen) == link["forward"]["forwarded"]


# This queue is smaller than the number of packets that arrive within milliseconds.
SLOW_LINE = ["tbf", "rate", "800kbit", "burst", "8kb", "limit", "16kb"]
MANY = 400
QUEUE_FULL = os.strerror(errno.ENOBUFS)


@pytest.fixture
def slow_line(namespaces: Namespaces) -> Iterator[Callable[[], int]]:
    """Install a slow queue from emulator to server; return a function that reads its length."""
    tc = (*namespaces.inside("emulator"), "tc")
    if shutil.which("tc") is None:
        pytest.skip("tc (iproute2) is not installed")
    made = subprocess.run(
        [*tc, "qdisc", "add", "dev", "inner", "root", *SLOW_LINE], capture_output=True, check=False
    )
    if made.returncode:
        pytest.skip(f"no queue discipline here: {made.stderr.decode().strip()}")

    def queued() -> int:
        show = [*tc, "-s", "-j", "qdisc", "show", "dev", "inner"]
        (found,) = json.loads(subprocess.check_output(show))
        return int(found["qlen"])

    yield queued
    subprocess.run([*tc, "qdisc", "del", "dev", "inner", "root"], check=True)


def unread(namespaces: Namespaces, version: int, port: int) -> int:
    """Return the number of received bytes that the emulator has not read yet from a port."""
    table = "/proc/net/udp" if version == 4 else "/proc/net/udp6"
    rows = subprocess.check_output([*namespaces.inside("emulator"), "cat", table], text=True)
    for row in rows.splitlines()[1:]:
        _, local, _, _, queues, *_ = row.split()
        if int(local.rpartition(":")[2], 16) == port:
            return int(queues.partition(":")[2], 16)
    raise AssertionError(rows)


@pytest.mark.parametrize(
    ("version", "options"), [(4, ["--segment"]), (6, ["--one-way"]), (4, ["--engine", "plain"])]
)
def test_packets_refused_by_a_full_output_queue_are_counted(
    namespaces: Namespaces,
    slow_line: Callable[[], int],
    emulate: Emulate,
    version: int,
    options: Sequence[str],
) -> None:
    """Every datagram is in one counter, and the emulator does not claim the guarantee."""
    outer, inner = OUTER[version], INNER[version]
    with subprocess.Popen(
        [*namespaces.inside("server"), sys.executable, str(ECHO), "count", inner.servers],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as counting:  # fmt: skip
        try:
            assert counting.stdout is not None
            emulator = emulate(
                url(inner.servers, int(counting.stdout.readline())), "loss 20% mansd 2", *options,
                listen=url(outer.servers, 0), inside=namespaces.inside("emulator"),
            )  # fmt: skip
            send = [sys.executable, str(ECHO), "send", outer.servers, str(emulator.port), str(MANY)]
            # From the emulator's namespace: no packet is lost before the emulator.
            subprocess.run([*namespaces.inside("emulator"), *send], check=True, timeout=60)
            while unread(namespaces, version, emulator.port):
                time.sleep(0.02)
            link, status, stderr = emulator.end()
            while slow_line():
                time.sleep(0.02)
            said, _ = counting.communicate(timeout=60)
        finally:
            counting.kill()
    forward = link["forward"]
    kernel, queue = (forward["unintended"][key] for key in ("lost_in_kernel", QUEUE_FULL))
    assert forward["received"] + kernel == MANY
    assert forward["forwarded"] == int(said) + queue
    assert queue > 0
    assert "queue on the way out was full" in stderr
    assert status == ExitStatus.UNINTENDED_LOSSES

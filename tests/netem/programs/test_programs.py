"""Programs through the emulator: iperf3, the tries of a client, a slow line between two hosts."""

import asyncio
import errno
import json
import os
import shlex
import shutil
import socket
import subprocess
import time
from asyncio.subprocess import PIPE
from asyncio.subprocess import Process as AsyncProcess
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

import pytest
from psutil import NoSuchProcess, Process

from benchmarks.programs import TwoHosts, two_hosts
from benchmarks.report import MeasurementError
from netem.emulator_options import LINK_NAME
from netem.tc_words import settings_of
from noack.core.errors import ExitStatus
from noack.runtime.address import text_of
from noack.runtime.udp_sockets import enlarge_buffer
from tests.attacks.attacked import unread_bytes
from tests.attacks.kinds import enter_namespace
from tests.netem.conftest import FORWARDED, Emulate, Emulator
from tests.oracles.link import Link

HOST = "127.0.0.1"
_ATTEMPTS = 20


async def open_iperf_server() -> tuple[AsyncProcess, int]:
    """Start an iperf3 server on a port that is free for TCP and UDP; return it and the port."""
    for _ in range(_ATTEMPTS):
        with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind((HOST, 0))
            port = tcp.getsockname()[1]
            try:
                udp.bind((HOST, port))
            except OSError:
                continue
        with suppress(OSError):
            return await iperf_server(port), port
    raise AssertionError("no free port")


WORDS = "delay 20ms 8ms loss 5% duplicate 3% mansd 5 first"
"""The first datagram of a stream opens it, and iperf3 does not repeat it."""


class Counts(NamedTuple):
    """The counters of an iperf3 receiver."""

    newest: int
    """Greatest datagram number; numbers begin at 1."""
    lost: int
    out_of_order: int


def counted(fates: Iterable[dict[str, Any]]) -> Iterator[Counts]:
    """Yield a receiver's counters after each datagram, by iperf3's manual and source.

    iperf3 counts a gap in the numbers as losses; a datagram out of order reduces this count by one.
    Datagram 0 of a flow only opens the stream.
    """
    departures = [
        (row["arrival_ns"] + row[field], row["packet"])
        for row in fates
        for field in ("delay_ns", "copy_delay_ns")
        if row["fate"] in FORWARDED and row[field] >= 0
    ]
    counts = Counts(0, 0, 0)
    for _, packet in sorted(departures, key=itemgetter(0)):  # a stable order
        newest, lost, out_of_order = counts
        if packet > newest:
            counts = Counts(packet, lost + packet - newest - 1, out_of_order)
        elif packet > 0:
            counts = Counts(newest, max(lost - 1, 0), out_of_order + 1)
        yield counts


async def iperf_server(port: int) -> AsyncProcess:
    """Start an iperf3 server for one test; raise OSError if it cannot listen."""
    server = await asyncio.create_subprocess_exec(
        "iperf3", "--server", "--bind", HOST, "--port", str(port), "--one-off", "--json",
        stdout=PIPE,
    )  # fmt: skip
    # With JSON output, iperf3 does not report that it listens.
    while server.returncode is None:
        with suppress(NoSuchProcess):
            if any(one.laddr.port == port for one in Process(server.pid).net_connections()):
                return server
        await asyncio.sleep(0.01)
    await server.communicate()
    raise OSError("iperf3 does not listen")


async def forward_tcp(port: int, to: int) -> asyncio.Server:
    """Forward connections to another port."""

    async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
        writer.close()

    async def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        answers, onward = await asyncio.open_connection(HOST, to)
        await asyncio.gather(carry(reader, onward), carry(answers, writer))

    return await asyncio.start_server(connect, HOST, port)


async def iperf_client(port: int, *options: str) -> dict[str, Any]:
    """Run an iperf3 client over UDP for a second; return its report."""
    client = await asyncio.create_subprocess_exec(
        "iperf3", "--client", HOST, "--port", str(port), "--udp", "--json", "--get-server-output",
        "--length", "200", "--bitrate", "400k", "--time", "1", *options, stdout=PIPE,
    )  # fmt: skip
    try:
        stdout, _ = await asyncio.wait_for(client.communicate(), 30)
    finally:
        if client.returncode is None:
            client.kill()
            await client.wait()
    report: dict[str, Any] = json.loads(stdout)
    assert client.returncode == 0, report.get("error")
    return report


async def measure(emulate: Emulate, *options: str) -> tuple[dict[str, Any], Emulator]:
    server, port = await open_iperf_server()
    try:
        while True:
            emulator = emulate(f"{HOST}:{port}", "--both", WORDS)
            try:
                forwarder = await forward_tcp(emulator.port, port)
                break
            except OSError:  # the port is free for UDP only
                emulator.finish()
        async with forwarder:
            return await iperf_client(emulator.port, *options), emulator
    finally:
        if server.returncode is None:
            server.kill()
        await server.communicate()


@pytest.mark.skipif(shutil.which("iperf3") is None, reason="iperf3 is not installed")
@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_iperf3_reports_the_losses_and_the_order_of_the_emulator(
    emulate: Emulate, direction: str
) -> None:
    options = ["--reverse"] if direction == "reverse" else []
    report, emulator = asyncio.run(measure(emulate, *options))
    link = emulator.finish()[direction]
    assert link["longest_loss_burst"] <= 5
    assert min(link["fates"]["dropped"], link["duplicated"]) > 0
    receiver = report if direction == "reverse" else report["server_output_json"]
    udp = receiver["end"]["streams"][0]["udp"]
    # The final report has the number sent; the intervals have increments of the newest number.
    newest = sum(one["streams"][0]["packets"] for one in receiver["intervals"])
    states = list(counted(emulator.fates(direction)))
    # iperf3's receiver stops at the end message over TCP and may leave datagrams unread.
    assert Counts(newest, udp["lost_packets"], udp["out_of_order"]) in states[len(states) // 2 :]
    assert min(udp["lost_packets"], udp["out_of_order"]) > 0


CASES = [
    ("loss worst mansd 2", "loss worst mansd 2", 3 * 3),
    ("loss worst mansd 1", "loss worst mansd 3", 2 * 4),
    ("loss 70% mansd 2", "loss 70% mansd 2", 3 * 3),
    ("loss gemodel 30% 20% mansd 2", "loss gemodel 30% 20% mansd 1", 3 * 2),
]
"""Words of the two directions, and the sufficient number of tries."""


@pytest.mark.parametrize(("forward", "reverse", "most"), CASES)
def test_the_bound_on_tries_holds_from_any_question_on(
    forward: str, reverse: str, most: int
) -> None:
    """docs/netem-programs.md proves it; a try is answered if the links pass both of its ways."""
    there, back = (
        Link(settings_of(shlex.split(words)), 0, LINK_NAME, direction)
        for words, direction in ((forward, "forward"), (reverse, "reverse"))
    )

    def passes(link: Link) -> bool:
        return link.decide(0, 30, 0).fate in FORWARDED

    answered = [passes(there) and passes(back) for _ in range(3000)]
    bursts = [len(list(burst)) for got, burst in groupby(answered) if not got]
    assert max(bursts) == most - 1


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
    except MeasurementError as error:
        pytest.skip(f"no network namespaces here: {error}")


def run(hosts: TwoHosts, *command: str) -> str:
    done = subprocess.run(hosts.inside(0, *command), capture_output=True, check=True, timeout=60)
    return done.stdout.decode()


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
        to, listen = text_of((there, server.getsockname()[1])), text_of((here, 0))
        words = ("loss 20% mansd 2", *options)
        emulator = emulate(to, *words, listen=listen, inside=hosts.inside(0))
        for _ in range(MANY):
            client.sendto(bytes(500), (here, emulator.port))
        while unread_bytes(emulator.process.pid)[emulator.port]:
            time.sleep(0.02)
        link, status, stderr = emulator.end()
        while json.loads(run(hosts, "tc", "-s", "-j", "qdisc", "show", "dev", "line"))[0]["qlen"]:
            time.sleep(0.02)
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

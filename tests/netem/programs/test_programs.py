"""Programs through the emulator: iperf3, QUIC, DNS; and a slow line between two hosts."""

import asyncio
import datetime
import errno
import json
import os
import shlex
import shutil
import socket
import socketserver
import subprocess
import time
from asyncio.subprocess import PIPE
from asyncio.subprocess import Process as AsyncProcess
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pytest
from aioquic.asyncio import connect, serve
from aioquic.quic.configuration import QuicConfiguration
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID
from dnslib import RR, DNSRecord
from dnslib.server import BaseResolver, DNSHandler, DNSLogger, DNSServer
from psutil import NoSuchProcess, Process

import noack
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

T = TypeVar("T")

HOST = "127.0.0.1"
_ATTEMPTS = 20


async def open_server(begin: Callable[[int], Awaitable[T]]) -> tuple[T, int]:
    """Start a server on a port that is free for TCP and UDP; return the server and the port."""
    for _ in range(_ATTEMPTS):
        with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            tcp.bind((HOST, 0))
            port = tcp.getsockname()[1]
            try:
                udp.bind((HOST, port))
            except OSError:
                continue
        try:
            return await begin(port), port
        except OSError:
            continue
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
    server, port = await open_server(iperf_server)
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


QUIC_WORDS = "delay 5ms 2ms loss 5% reorder 5% duplicate 2% corrupt 1% mansd 3"
CONTENT_BYTES = 300_000
PATIENCE_S = 60.0


@pytest.fixture
def certificate(tmp_path: Path) -> tuple[Path, Path]:
    """A self-signed certificate for localhost and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    files = tmp_path / "certificate.pem", tmp_path / "key.pem"
    files[0].write_bytes(signed.public_bytes(Encoding.PEM))
    files[1].write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    return files


def test_content_arrives_unchanged_in_both_directions(certificate: tuple[Path, Path]) -> None:
    content = np.random.default_rng(0).bytes(CONTENT_BYTES)
    received: list[bytes] = []

    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        received.append(await reader.read())
        writer.write(received[-1][::-1])
        writer.write_eof()

    async def ask(host: str, port: int) -> bytes:
        trusting = QuicConfiguration(is_client=True, server_name="localhost")
        trusting.load_verify_locations(str(certificate[0]))
        async with connect(host, port, configuration=trusting) as client:
            reader, writer = await client.create_stream()
            writer.write(content)
            writer.write_eof()
            return await reader.read()

    async def go() -> tuple[bytes, noack.LossyUdp]:
        own = QuicConfiguration(is_client=False)
        own.load_cert_chain(*certificate)
        tasks: list[asyncio.Future[None]] = []
        server, port = await open_server(
            lambda port: serve(
                HOST, port, configuration=own,
                stream_handler=lambda *ends: tasks.append(asyncio.ensure_future(echo(*ends))),
            )
        )  # fmt: skip
        try:
            async with noack.LossyUdp((HOST, port), QUIC_WORDS, reverse=QUIC_WORDS, seed=1) as link:
                answer = await asyncio.wait_for(ask(*link.address), PATIENCE_S)
        finally:
            server.close()
        return answer, link

    answer, link = asyncio.run(go())
    assert received == [content]
    assert answer == content[::-1]
    for of in (link.forward, link.reverse):
        assert of["received_bytes"] > CONTENT_BYTES
        assert of["fates"]["dropped"] * of["fates"]["corrupted"] * of["duplicated"] > 0
        assert of["delivered_out_of_order"] > 0
        assert of["longest_loss_burst"] <= 3


TIMEOUT_S = 0.03
"""Timeout of a try. A later answer costs another try but carries the number of its own try."""
QUESTIONS = 4


CASES = [
    ("loss worst mansd 2", "loss worst mansd 2", 3 * 3),
    ("loss worst mansd 1", "loss worst mansd 3", 2 * 4),
    ("loss 70% mansd 2", "loss 70% mansd 2", 3 * 3),
    ("loss gemodel 30% 20% mansd 2", "loss gemodel 30% 20% mansd 1", 3 * 2),
]
"""Words of the two directions, and the sufficient number of tries."""


class Zone(BaseResolver):
    """The zone of a server; the address of each name contains the name's number."""

    def resolve(self, request: DNSRecord, handler: DNSHandler) -> DNSRecord:
        reply = request.reply()
        number = str(request.q.qname).partition(".")[0]
        reply.add_answer(*RR.fromZone(f"{request.q.qname} 60 A 192.0.2.{number}"))
        return reply


@contextmanager
def dns_server() -> Iterator[str]:
    silent = DNSLogger(logf=lambda _: None)
    # dnslib's own server answers in threads, and so in any order.
    server = DNSServer(
        Zone(), address="127.0.0.1", port=0, logger=silent, server=socketserver.UDPServer
    )
    server.start_thread()
    try:
        yield "{}:{}".format(*server.server.server_address)
    finally:
        server.stop()
        server.thread.join()
        server.server.server_close()


class Client:
    """Repeats a question until it is answered; each try has its own identifier."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.settimeout(TIMEOUT_S)
        self._socket.connect((host, port))
        self.tries = 0

    def ask(self, number: int) -> tuple[int, int]:
        """Return the first try of the question, and that which was answered first."""
        first = self.tries
        while True:
            question = DNSRecord.question(f"{number}.example")
            question.header.id = self.tries
            self.tries += 1
            self._socket.send(question.pack())
            with suppress(TimeoutError):
                while True:
                    answer = DNSRecord.parse(self._socket.recv(512))
                    if answer.header.id >= first:
                        assert str(answer.a.rdata) == f"192.0.2.{number}"
                        return first, int(answer.header.id)

    def close(self) -> None:
        self._socket.close()


def answered(forward: str, reverse: str) -> Iterator[bool]:
    """Yield for each try whether it gets an answer, as the links decide without sockets."""
    there, back = (
        Link(settings_of(shlex.split(words)), 0, LINK_NAME, direction)
        for words, direction in ((forward, "forward"), (reverse, "reverse"))
    )
    while True:
        yield passes(there) and passes(back)


def passes(link: Link) -> bool:
    return link.decide(0, 30, 0).fate in FORWARDED


def test_the_tries_of_a_client_reach_the_bound(emulate: Emulate) -> None:
    """docs/netem-programs.md proves it. The client keeps its socket: a new one is a new flow."""
    forward, reverse, most = CASES[0]
    with dns_server() as server:
        emulator = emulate(server, forward, "--reverse", reverse)
        with closing(Client(emulator.host, emulator.port)) as client:
            asked = [client.ask(number) for number in range(QUESTIONS)]
        link = emulator.finish()
    assert link["forward"]["received"] == client.tries
    got = list(islice(answered(forward, reverse), client.tries))
    assert [last for _, last in asked] == [got.index(True, first) for first, _ in asked]
    needed = [last - first + 1 for first, last in asked]
    assert max(needed) == needed[0] == most


@pytest.mark.parametrize(("forward", "reverse", "most"), CASES)
def test_the_bound_on_tries_holds_from_any_question_on(
    forward: str, reverse: str, most: int
) -> None:
    expected = list(islice(answered(forward, reverse), 3000))
    bursts = [len(list(burst)) for got, burst in groupby(expected) if not got]
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

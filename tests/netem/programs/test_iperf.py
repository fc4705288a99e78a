"""iperf3's report on a stream agrees with the emulator's record.

iperf3 uses the same port number for its UDP datagrams and its TCP control connection. The emulator
relays the datagrams; a forwarder in this module relays the connection.
"""

import asyncio
import json
import shutil
from asyncio.subprocess import PIPE
from asyncio.subprocess import Process as AsyncProcess
from collections.abc import Iterable, Iterator
from contextlib import suppress
from operator import itemgetter
from typing import Any, NamedTuple

import pytest
from psutil import NoSuchProcess, Process

from tests.netem.conftest import FORWARDED, Emulate, Emulator
from tests.netem.programs.ports import HOST, open_server

pytestmark = pytest.mark.skipif(shutil.which("iperf3") is None, reason="iperf3 is not installed")

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

"""Run iperf3 over UDP through an emulator, and model the counters of its receiver.

iperf3 uses the same port number for its UDP datagrams and its TCP control connection. The emulator
relays the datagrams; a forwarder in this module relays the connection.
"""

import asyncio
import json
from asyncio.subprocess import PIPE
from asyncio.subprocess import Process as AsyncProcess
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

from psutil import NoSuchProcess, Process

from tests.netem.programs.emulator import Departure
from tests.netem.programs.ports import HOST


class Counts(NamedTuple):
    """The counters of an iperf3 receiver for a stream."""

    newest: int
    """Greatest datagram number; numbers begin at 1."""
    lost: int
    out_of_order: int


class Measured(NamedTuple):
    """The reports of iperf3's client and server."""

    client: dict[str, Any]
    server: dict[str, Any]

    def counts(self, stream: int, reverse: bool) -> Counts:
        receiver = self.client if reverse else self.server
        udp = receiver["end"]["streams"][stream]["udp"]
        # The final report has the number sent; the intervals have increments of the newest number.
        newest = sum(one["streams"][stream]["packets"] for one in receiver["intervals"])
        return Counts(newest, udp["lost_packets"], udp["out_of_order"])


def counted(departures: Iterable[Departure]) -> Iterator[Counts]:
    """Yield a receiver's counters after each datagram, by iperf3's manual and source.

    iperf3 counts a gap in the numbers as losses; a datagram out of order reduces this count by one.
    Datagram 0 of a flow only opens the stream.
    """
    counts = Counts(0, 0, 0)
    for departure in departures:
        newest, lost, out_of_order = counts
        if departure.packet > newest:
            counts = Counts(departure.packet, lost + departure.packet - newest - 1, out_of_order)
        elif departure.packet > 0:
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
        try:
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
        except ConnectionError:
            pass
        finally:
            writer.close()

    async def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, onward = await asyncio.open_connection(HOST, to)
        await asyncio.gather(carry(reader, onward), carry(there, writer))

    return await asyncio.start_server(connect, HOST, port)


async def iperf_client(port: int, *options: str) -> Measured:
    """Run an iperf3 client over UDP; return what it and its server report."""
    client = await asyncio.create_subprocess_exec(
        "iperf3", "--client", HOST, "--port", str(port), "--udp", "--json", "--get-server-output",
        *options, stdout=PIPE,
    )  # fmt: skip
    try:
        stdout, _ = await asyncio.wait_for(client.communicate(), 30)
    finally:
        if client.returncode is None:
            client.kill()
            await client.wait()
    report = json.loads(stdout)
    assert client.returncode == 0, report.get("error")
    return Measured(report, report["server_output_json"])

"""iperf3 over UDP through an emulator, and how its receiver counts.

iperf3 has a TCP connection for control on the port that its datagrams go to. The emulator takes the
datagrams; a forwarder here, on the same port, takes the connection.
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
    """What an iperf3 receiver has counted of a stream."""

    newest: int
    """Greatest number among the datagrams; they begin at 1."""
    lost: int
    out_of_order: int


class Measured(NamedTuple):
    """What iperf3 reports."""

    client: dict[str, Any]
    server: dict[str, Any]

    def counts(self, stream: int, reverse: bool) -> Counts:
        receiver = self.client if reverse else self.server
        udp = receiver["end"]["streams"][stream]["udp"]
        # At the end it tells how many were sent, at intervals by how much the newest number rose.
        newest = sum(one["streams"][stream]["packets"] for one in receiver["intervals"])
        return Counts(newest, udp["lost_packets"], udp["out_of_order"])


def counted(departures: Iterable[Departure]) -> Iterator[Counts]:
    """What a receiver has counted after each datagram, as iperf3's manual and source tell it.

    A gap in the numbers is lost until something arrives out of order, which fills it. Datagram 0 of
    a flow only says that there is a stream.
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
    """An iperf3 server for one test, which listens; OSError if it cannot."""
    server = await asyncio.create_subprocess_exec(
        "iperf3", "--server", "--bind", HOST, "--port", str(port), "--one-off", "--json",
        stdout=PIPE,
    )  # fmt: skip
    # It does not say when it listens, if its report shall be JSON.
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

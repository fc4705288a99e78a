"""Requests of tests, by the standard library's client and by bytes of their own."""

import http.client
import json
import socket
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from netem.control.control_server import ControlAddresses

Connect = Callable[[], socket.socket]


class Answered(NamedTuple):
    """An answer."""

    status: int
    headers: Mapping[str, str]
    text: str

    @property
    def document(self) -> Any:
        """The content as JSON."""
        return json.loads(self.text)


def unix(addresses: ControlAddresses) -> Connect:
    """Return how to connect to the Unix socket."""

    def connect() -> socket.socket:
        connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(60)
        connection.connect(str(addresses.socket))
        return connection

    return connect


def tcp(addresses: ControlAddresses) -> Connect:
    """Return how to connect to the loopback port."""
    assert addresses.url is not None
    port = int(addresses.url.rpartition(":")[2])
    return lambda: socket.create_connection(("127.0.0.1", port), 60)


def request(
    connect: Connect, method: str, path: str, body: str | bytes | None = None, **headers: str
) -> Answered:
    """Return the answer to a request."""
    client = http.client.HTTPConnection("localhost")
    client.sock = connection = connect()
    client.request(method, path, body, headers)
    return _read(client.getresponse(), connection)


def send(connect: Connect, data: bytes) -> Answered:
    """Return the answer to bytes."""
    connection = connect()
    connection.sendall(data)
    response = http.client.HTTPResponse(connection)
    response.begin()
    return _read(response, connection)


def _read(response: http.client.HTTPResponse, connection: socket.socket) -> Answered:
    text = response.read().decode()
    connection.close()
    return Answered(response.status, dict(response.headers), text)

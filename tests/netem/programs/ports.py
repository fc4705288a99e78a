"""Find ports for servers that cannot choose and report a port themselves."""

import socket
from collections.abc import Awaitable, Callable
from typing import TypeVar

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

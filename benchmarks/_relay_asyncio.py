"""A peer of the relay benchmarks: a straightforward asyncio relay.

``python -m benchmarks._relay_asyncio PORT [--delay-ms MS]`` forwards to PORT on loopback, each
datagram MS later, and prints the port on which it listens.
"""

import argparse
import asyncio
import socket

LOOPBACK = "127.0.0.1"
BUFFER_BYTES = 4 * 1024 * 1024
_SO_RCVBUFFORCE = 33


class Forward(asyncio.DatagramProtocol):
    """Forwards received datagrams through a connected endpoint, at once or after the delay."""

    def __init__(self, out: asyncio.DatagramTransport, delay_s: float) -> None:
        self._out = out
        self._delay_s = delay_s
        self._loop = asyncio.get_running_loop()

    def datagram_received(self, data: bytes, addr: object) -> None:
        """Forward a datagram."""
        if self._delay_s:
            self._loop.call_later(self._delay_s, self._out.sendto, data)
        else:
            self._out.sendto(data)


async def serve(port: int, delay_s: float) -> None:
    """Forward until killed."""
    loop = asyncio.get_running_loop()
    out, _ = await loop.create_datagram_endpoint(
        asyncio.DatagramProtocol, remote_addr=(LOOPBACK, port)
    )
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, BUFFER_BYTES)
    except PermissionError:
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    endpoint.bind((LOOPBACK, 0))
    endpoint.setblocking(False)
    await loop.create_datagram_endpoint(lambda: Forward(out, delay_s), sock=endpoint)
    print(endpoint.getsockname()[1], flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("--delay-ms", type=float, default=0.0)
    options = parser.parse_args()
    asyncio.run(serve(options.port, options.delay_ms / 1e3))

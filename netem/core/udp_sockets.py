"""UDP sockets: how they are bound, their receive buffers, and what the kernel dropped there."""

import errno
import socket
import struct
from contextlib import suppress

from netem.core.address import SocketName
from netem.core.errors import CallerError

_SO_MEMINFO = 55
"""Option of a socket with its memory in words; one of them counts dropped datagrams."""
_MEMINFO_WORDS = 9
_MEMINFO_DROPS = 8
MAX_UDP_BYTES = 65_535
# The default receive buffer holds 256 small datagrams; 4 MiB hold about 10,000. A datagram lost by
# overflow is an unintended loss, which breaks the MANSD guarantee.
_BUFFER_BYTES = 4 * 1024 * 1024
_SO_RCVBUFFORCE = 33


def bind_to(endpoint: socket.socket, name: SocketName, title: str, remedy: str) -> None:
    """Bind a socket; if that fails, close it and raise CallerError."""
    try:
        endpoint.bind(name)
    except OSError as error:
        endpoint.close()
        if error.errno == errno.EADDRNOTAVAIL:  # another port does not help
            raise CallerError(f"{title}: {name[0]} is no address of this machine; see `ip address`") from None
        reason = {
            errno.EADDRINUSE: "is already taken by another program",
            errno.EACCES: "needs privileges that this user does not have",
        }.get(error.errno or 0, f"cannot be bound ({error.strerror})")
        raise CallerError(f"{title} {reason}; {remedy}") from None


def drops_of(endpoint: socket.socket) -> int | None:
    """Datagrams that the kernel dropped at a socket; None if the system has no such counter.

    This counter is always exact and costs nothing per datagram. The one that arrives with
    datagrams (SO_RXQ_OVFL) is exact only after the next datagram. Datagrams that the kernel passes
    together, as it does between processes of several loops, count as one.
    """
    try:
        data = endpoint.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * _MEMINFO_WORDS)
    except OSError:
        return None
    words = struct.unpack(f"={len(data) // 4}I", data[: len(data) // 4 * 4])
    return words[_MEMINFO_DROPS] if len(words) > _MEMINFO_DROPS else None


def enlarge_buffer(endpoint: socket.socket, size_bytes: int | None = None) -> int:
    """Request a receive buffer, by default of 4 MiB; return the size that the kernel set."""
    size_bytes = size_bytes or _BUFFER_BYTES
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, size_bytes)
    except OSError:
        with suppress(OSError):
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size_bytes)
    return endpoint.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

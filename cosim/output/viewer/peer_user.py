"""Whose process is at the other end of a TCP connection on the loopback interface."""

import socket
import sys
from pathlib import Path

_SOCKETS = Path("/proc/net/tcp")
_TRIES = 3
"""The kernel's list may leave out a socket while others come and go."""


def peer_user(connection: socket.socket) -> int | None:
    """Return the user id that holds the other end; None if nobody does, or it is unknown.

    Linux's list of sockets names the user of each. A connection that no process has accepted yet
    has none.
    """
    try:
        wanted = [_written(connection.getpeername()), _written(connection.getsockname())]
        for _ in range(_TRIES):
            for line in _SOCKETS.read_text().splitlines()[1:]:
                fields = line.split()
                user, inode = fields[7], fields[9]
                if fields[1:3] == wanted and inode != "0":
                    return int(user)
    except OSError:  # it is broken, or this is not Linux
        pass
    return None


def _written(address: tuple[str, int]) -> str:
    """An address as the list has it."""
    host, port = address
    return f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"

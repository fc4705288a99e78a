"""Finds the user of the process at the other end of a TCP connection on loopback."""

import socket
import sys
from pathlib import Path

_SOCKETS = Path("/proc/net/tcp")
_TRIES = 3
"""Maximum tries: the kernel's list may miss a socket while others open and close."""


def peer_user(connection: socket.socket) -> int | None:
    """Return the user id of the process at the other end; None if there is none, or it is unknown.

    Linux's list of sockets has the user of each. A connection that no process has accepted yet has
    no user.
    """
    try:
        wanted = [_written(connection.getpeername()), _written(connection.getsockname())]
        for _ in range(_TRIES):
            for line in _SOCKETS.read_text().splitlines()[1:]:
                fields = line.split()
                user, inode = fields[7], fields[9]
                if fields[1:3] == wanted and inode != "0":
                    return int(user)
    except OSError:  # the connection is broken, or this is not Linux
        pass
    return None


def _written(address: tuple[str, int]) -> str:
    """Return an address in the list's format."""
    host, port = address
    return f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"

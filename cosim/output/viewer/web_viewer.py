"""The web viewer's files, which rerun's program contains and serves on its own port.

Any user of the machine could listen on that port once the program has ended. Therefore the kernel
selects the port, and an answer is used only if it comes from a process of this user.
"""

import contextlib
import http.client
import os
import re
import socket
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from cosim.output.viewer.rerun_program import end_process, logged_port, start_rerun
from noack.core.errors import MachineError, PeerError

HOST = "127.0.0.1"

_START_S = 10.0
_TIMEOUT_S = 10.0
_SOCKETS = Path("/proc/net/tcp")
_TRIES = 3
"""Maximum tries: the kernel's list may miss a socket while others open and close."""
_SERVED_AT = re.compile(rb"(?<!\+)http://127\.0\.0\.1:(\d+)")


class WebViewer:
    """Serves the web viewer's files until it is closed.

    Raises:
        MachineError: rerun's program does not start.
    """

    def __init__(self) -> None:
        # With the address of a recording that a page can load, the program only serves the page.
        # With a file it uses a whole core, and without either it opens another data port. The page
        # gets the recording's real address otherwise: every user can read a command line.
        arguments = ["--serve-web", "--bind", HOST, "--web-viewer-port", "0"]
        with tempfile.TemporaryFile() as output:
            self.process = start_rerun([*arguments, f"http://{HOST}/recording.rrd"], output=output)
            port = logged_port(self.process, output, _SERVED_AT, _START_S)
        if port is None:
            self.close()
            raise MachineError("rerun's web viewer did not start")
        self.port = port

    @contextlib.contextmanager
    def file(self, name: str) -> Iterator[http.client.HTTPResponse]:
        """Yield the answer to a request for a file; it is valid within the context.

        Raises:
            PeerError: the program has ended, or the answering process is not this user's.
        """
        source = http.client.HTTPConnection(HOST, self.port, timeout=_TIMEOUT_S)
        with contextlib.closing(source):
            try:
                source.connect()
                connection = source.sock
                source.request("GET", f"/{name}")
                answer = source.getresponse()
            except (OSError, http.client.HTTPException):
                raise PeerError("rerun's web viewer does not answer") from None
            # Checked now, since a connection has no user before it is accepted. The answer comes
            # over this same connection, even if another process listens on the port meanwhile.
            if self.process.poll() is not None or peer_user(connection) != os.getuid():
                raise PeerError("rerun's web viewer has ended, or another user's program answers")
            yield answer

    def close(self) -> None:
        """End the program."""
        end_process(self.process)


def peer_user(connection: socket.socket) -> int | None:
    """Return the user id of the process at the other end; None if there is none, or it is unknown.

    A connection that no process has accepted yet has no user.
    """
    try:
        return socket_user(connection.getpeername(), connection.getsockname())
    except OSError:  # the connection is broken
        return None


def socket_user(own: tuple[str, int], peer: tuple[str, int]) -> int | None:
    """Return the user id of a socket by its addresses; None if there is none, or it is unknown.

    Linux's list of sockets has the user of each.
    """
    try:
        wanted = [_written(own), _written(peer)]
        for _ in range(_TRIES):
            for line in _SOCKETS.read_text().splitlines()[1:]:
                fields = line.split()
                user, inode = fields[7], fields[9]
                if fields[1:3] == wanted and inode != "0":
                    return int(user)
    except OSError:  # this is not Linux
        pass
    return None


def _written(address: tuple[str, int]) -> str:
    """Return an address in the list's format."""
    host, port = address
    return f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"

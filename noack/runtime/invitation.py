"""Invitations: files by which processes on other hosts join a run.

An invitation is a ticket with the address of the control plane and keys for it. Whoever can read it
can take part in the run, so it is for its owner only.
"""

import os
import socket
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from noack.core.errors import CallerError, PeerError, why
from noack.core.file_access import new_file, open_regular, read_regular
from noack.runtime.address import Address, family_of, text_of
from noack.runtime.join_ticket import Ticket, loads

STANDARD_INPUT = Path("-")
"""An invitation by this name is read from standard input."""
_MOST_BYTES = 64 * 2**20
"""Of an invitation: more than any scenario needs."""


@contextmanager
def invitation_file(path: Path, ticket: Ticket) -> Iterator[None]:
    """Write an invitation that only its owner can read; replace an older one.

    At the end it is removed, unless that of another run has replaced it.

    Raises:
        CallerError: it cannot be written.
    """
    write_invitation(path, ticket)
    try:
        yield
    finally:
        with suppress(OSError, ValueError):
            if read_regular(path, _MOST_BYTES) == _content(ticket):
                path.unlink()


def write_invitation(path: Path, ticket: Ticket) -> None:
    """Write an invitation that only its owner can read; replace an older one.

    Raises:
        CallerError: it cannot be written.
    """
    try:
        with new_file(path, make_folder=False, mode=0o600) as file:
            file.write(_content(ticket))
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: the invitation cannot be written: {why(error)}") from None


def _content(ticket: Ticket) -> bytes:
    return (ticket.model_dump_json(indent=1) + "\n").encode()


def read_invitation(path: Path, runs: Path) -> Ticket:
    """Return the ticket of an invitation, as this host uses it.

    Sockets of loop data listen on the address from which this host reaches the coordinator. Rows
    that cannot be sent to the recorder stay below ``runs``, in a folder with the run's name.

    Raises:
        CallerError: it cannot be read, other users can read it, or it is no invitation; or
            ``runs`` cannot be written.
        PeerError: there is no route to the coordinator.
    """
    content = _bytes_of(path)
    try:
        ticket = loads(_text(content))
    except CallerError as error:
        raise CallerError(f"{path}: not an invitation: {error}") from None
    if ticket.remote is None:
        raise CallerError(f"{path}: not an invitation, but a ticket for this host")
    name = Path(ticket.run_dir).name
    if name in ("", "..") or "\0" in name:
        raise CallerError(f"{path}: not an invitation: its run directory has no name")
    _require_writable(runs.resolve())
    run_dir = runs.resolve() / name
    host = own_host((ticket.remote.host, ticket.remote.port))
    return ticket.model_copy(update={"host": host, "run_dir": str(run_dir)})


def _bytes_of(path: Path) -> bytes:
    try:
        if path == STANDARD_INPUT:
            return sys.stdin.buffer.read(_MOST_BYTES + 1)
        with open_regular(path) as file:
            status = os.fstat(file.fileno())
            if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
                raise CallerError(
                    f"{path}: it has secret keys, but other users can read or change it; "
                    f"make it yours alone: chmod 600 {path}"
                )
            return file.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = why(error) if isinstance(error, OSError) else error
        raise CallerError(f"{path}: the invitation cannot be read: {reason}") from None


def _text(content: bytes) -> str:
    if len(content) > _MOST_BYTES:
        raise CallerError(f"larger than {_MOST_BYTES // 2**20} MiB")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise CallerError("it is no text") from None


def _require_writable(folder: Path) -> None:
    """Raise CallerError unless a folder can be made or written: rows may have to be kept there."""
    nearest = folder
    while not os.access(nearest, os.F_OK) and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir():
        raise CallerError(f"{folder}: rows could not be kept there: {nearest} is no folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise CallerError(f"{folder}: rows could not be kept there: {nearest} is not writable")


def own_host(other: Address) -> str:
    """Return the numeric address from which this host sends to another one.

    Raise PeerError without a route.
    """
    with socket.socket(family_of(other), socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(other)  # sends nothing
        except OSError as error:
            raise PeerError(f"cannot reach {text_of(other)}: {why(error)}") from None
        return str(probe.getsockname()[0])

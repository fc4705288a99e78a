"""Invitations: files by which processes on other hosts join a run.

An invitation is a ticket with the address of the control plane and keys for it. Whoever can read it
can take part in the run, so it is for its owner only.
"""

import os
import socket
import stat
import sys
from contextlib import suppress
from pathlib import Path

from noack.core.errors import CallerError, PeerError, why
from noack.runtime.address import Address, family_of, text_of
from noack.runtime.join_ticket import Ticket, loads


def write_invitation(path: Path, ticket: Ticket) -> None:
    """Write an invitation that only its owner can read; replace an older one.

    Raises:
        CallerError: it cannot be written.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with suppress(FileNotFoundError):
            scratch.unlink()
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with os.fdopen(os.open(scratch, flags, 0o600), "w") as file:
            file.write(ticket.model_dump_json(indent=1) + "\n")
        scratch.replace(path)
    except OSError as error:
        raise CallerError(f"{path}: the invitation cannot be written: {why(error)}") from None


STANDARD_INPUT = Path("-")
"""An invitation by this name is read from standard input."""


def read_invitation(path: Path, runs: Path) -> Ticket:
    """Return the ticket of an invitation, as this host uses it.

    Sockets of loop data listen on the address from which this host reaches the coordinator. Rows
    that cannot be sent to the recorder stay below ``runs``, in a folder with the run's name.

    Raises:
        CallerError: it cannot be read, other users can read it, or it is no invitation.
        PeerError: there is no route to the coordinator.
    """
    text = _text_of(path)
    try:
        ticket = loads(text)
    except CallerError as error:
        raise CallerError(f"{path}: not an invitation: {error}") from None
    if ticket.remote is None:
        raise CallerError(f"{path}: not an invitation, but a ticket for this host")
    run_dir = runs.resolve() / Path(ticket.run_dir).name
    host = own_host((ticket.remote.host, ticket.remote.port))
    return ticket.model_copy(update={"host": host, "run_dir": str(run_dir)})


def _text_of(path: Path) -> str:
    try:
        if path == STANDARD_INPUT:
            return sys.stdin.read()
        with path.open(encoding="utf-8") as file:
            status = os.fstat(file.fileno())
            if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
                raise CallerError(
                    f"{path}: it has secret keys, but other users can read or change it; "
                    f"make it yours alone: chmod 600 {path}"
                )
            return file.read()
    except (OSError, UnicodeDecodeError) as error:
        reason = why(error) if isinstance(error, OSError) else "it is no text"
        raise CallerError(f"{path}: the invitation cannot be read: {reason}") from None


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

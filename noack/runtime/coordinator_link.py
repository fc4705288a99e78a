"""Connects a process with a coordinator on another host, by a program of its own between both.

zenoh connects to a Unix socket without a name. The program accepts these connections, opens one
with the coordinator for each, proves that it has an invitation, and forwards the bytes by TLS. It
is a separate process, since a thread would keep the loop waiting for the interpreter's lock.
"""

import asyncio
import json
import os
import secrets
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from noack.core.errors import MachineError, NoAnswerError, PeerError, why
from noack.core.python_process import python_command
from noack.protocol.invitation_proof import Answer, InvitationProof
from noack.runtime.connection_forwarder import Streams, forwarding
from noack.runtime.private_folder import open_private
from noack.runtime.tls_context import tls_context

_FOLDER = "links"
_OPEN_S = 4.0
"""Longest time for a connection with the coordinator."""
_PATIENCE_S = 10.0
"""Time within which the first connection is tried again."""
_LINGER_S = 5.0
"""Longest time for which the program, at the end, sends what it has received."""
_PAUSE_S = 0.2
_READY = b"ready\n"
_BACKLOG = 16
_FOREIGN = (
    "a program listens there, but does not accept this invitation; each run has a new one: copy "
    "that of the open run"
)
_FLOODED = (
    "it had no room for this connection: other connections flood its port; start this process "
    "again, and see what `noack record` says about the flood"
)


class Destination(NamedTuple):
    """A coordinator, and the keys of those that join, as PEM text; the run's key in hexadecimal."""

    host: str
    port: int
    authority: str
    certificate: str
    private_key: str
    key: str


@contextmanager
def coordinator_link(destination: Destination) -> Iterator[str]:
    """Open a link within the context; yield the path of its Unix socket, for this process.

    Raises:
        NoAnswerError: the coordinator cannot be reached.
        MachineError: the program cannot be started.
        CallerError: other users have access to the user's runtime directory.
    """
    with _unnamed_socket() as (listening, path):
        command = python_command("-m", __name__, listening.fileno())
        try:
            # In a session of its own, so that Ctrl-C does not end it before this process.
            program = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, pass_fds=[listening.fileno()], start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise MachineError(f"cannot start the link to the coordinator: {why(error)}") from None
        assert program.stdin is not None
        assert program.stdout is not None
        with program:
            try:
                with suppress(BrokenPipeError):
                    program.stdin.write(json.dumps(destination).encode() + b"\n")
                    program.stdin.flush()
                said = program.stdout.readline()
                if not said:
                    raise MachineError("the link to the coordinator did not start")
                if said != _READY:
                    raise NoAnswerError(said.decode().strip())
                yield path
            finally:
                with suppress(BrokenPipeError):
                    program.stdin.close()
                try:
                    program.wait(2 * _LINGER_S)
                except subprocess.TimeoutExpired:
                    program.kill()


@contextmanager
def _unnamed_socket() -> Iterator[tuple[socket.socket, str]]:
    """Give a Unix socket that listens, and a path by which only this process reaches it."""
    with open_private(_FOLDER, create=True) as folder, socket.socket(socket.AF_UNIX) as listening:
        name = f"/proc/self/fd/{folder.descriptor}/{secrets.token_hex(8)}"
        listening.bind(name)
        listening.listen(_BACKLOG)
        descriptor = os.open(name, os.O_PATH | os.O_CLOEXEC)
        os.unlink(name)  # noqa: PTH108 - reached through the folder's descriptor
        try:
            yield listening, f"/proc/self/fd/{descriptor}"
        finally:
            os.close(descriptor)


async def connect(destination: Destination) -> Streams:
    """Connect with the coordinator by TLS; the message of an error is for the person who tries.

    Raises:
        NoAnswerError: that fails, and may succeed later.
        PeerError: that fails.
    """
    try:
        async with asyncio.timeout(_OPEN_S):
            return await _connect(destination)
    except TimeoutError:
        raise NoAnswerError(
            "no answer; is it the recording host's address? Do firewalls pass TCP to this port? "
            "Is that host flooded with connections?"
        ) from None
    except ConnectionRefusedError:
        raise PeerError(
            "nothing listens there; if `noack record` has ended, copy the invitation of a new one"
        ) from None
    except (ConnectionResetError, ConnectionAbortedError):
        raise NoAnswerError(
            "it closed the connection without an answer; has `noack record` just ended, or do "
            "other connections flood its port?"
        ) from None
    except ssl.SSLError:
        raise PeerError(_FOREIGN) from None
    except OSError as error:
        raise PeerError(why(error)) from None


async def _connect(destination: Destination) -> Streams:
    reader, writer = await asyncio.open_connection(destination.host, destination.port)
    try:
        proof = InvitationProof(bytes.fromhex(destination.key))
        addresses = (writer.get_extra_info(name)[:2] for name in ("sockname", "peername"))
        writer.write(proof.make(*addresses))
        answer = await reader.read(1)
        if answer == Answer.NO_ROOM:
            raise NoAnswerError(_FLOODED)
        if answer == b"":
            raise ConnectionResetError
        if answer != Answer.ADMITTED:
            raise PeerError(_FOREIGN)
        context = tls_context(
            destination.authority, destination.certificate, destination.private_key, server=False
        )
        await writer.start_tls(context, server_hostname=destination.host)
    except BaseException:
        writer.transport.abort()
        raise
    return reader, writer


def _main() -> None:
    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(one, signal.SIG_IGN)  # it ends after the process that it serves
    destination = Destination(*json.loads(sys.stdin.buffer.readline()))
    prepared: list[Streams] = []

    async def target() -> Streams:
        return prepared.pop() if prepared else await connect(destination)

    with (
        socket.socket(fileno=int(sys.argv[1])) as listening,
        forwarding(listening, target, linger_s=_LINGER_S) as loop,
        suppress(BrokenPipeError),  # the other process has ended
    ):
        opening = asyncio.run_coroutine_threadsafe(_connect_patiently(destination), loop)
        try:
            prepared.append(opening.result())
        except PeerError as error:
            os.write(sys.stdout.fileno(), f"{error}\n".encode())
            return
        os.write(sys.stdout.fileno(), _READY)
        sys.stdin.buffer.read()  # ends when the other process closes it, or ends


async def _connect_patiently(destination: Destination) -> Streams:
    """Connect with the coordinator; try again while that may succeed later."""
    until_s = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return await connect(destination)
        except NoAnswerError:
            if time.monotonic() > until_s:
                raise
            await asyncio.sleep(_PAUSE_S)


if __name__ == "__main__":
    _main()

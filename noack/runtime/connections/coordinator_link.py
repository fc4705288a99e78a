"""The connection of a process with a coordinator on another host: proof, TLS, forwarded bytes.

zenoh connects to a Unix socket without a name. A program of its own accepts these connections,
opens one with the coordinator for each, proves that it has an invitation, and forwards the bytes by
TLS. It is a separate process, since a thread would keep the loop waiting for the interpreter's
lock. The coordinator's host forwards accepted connections to its own socket, on a thread.

A connection begins with the proof, which is checked before anything that costs more: a flood of
connections without it costs little (see ``connection_gate.py``), and never ends those with one.
Layout, version 1::

    offset  size  field
         0     4  the bytes "NJ", version 1, reserved 0
         4    16  tag: keyed BLAKE2b over the four bytes and the connection's addresses

The addresses are those of the connecting end and of the coordinator, each as 16 bytes (of IPv4: 4
bytes and 12 zeros) and its port in two bytes, big endian. So the proof of one connection is of no
use for another one. The coordinator answers with one byte (:class:`Answer`); then TLS 1.3 begins,
in which both ends have certificates. When too many handshakes of connections with a proof are
unfinished, the oldest one ends of the host that has the most. When too many connections are
forwarded, the newest ends of the host that has the most.
"""

import asyncio
import hashlib
import hmac
import ipaddress
import json
import os
import secrets
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from noack.core.errors import MachineError, NoAnswerError, PeerError, why
from noack.core.system_processes import python_command
from noack.protocol.wire_format import KEY_BYTES, TAG_BYTES, Tagger
from noack.runtime.connections.connection_gate import FirstBytes, TaskLimit, accepting
from noack.runtime.private_folder import open_private

_HEAD = b"NJ\x01\x00"
PROOF_BYTES = len(_HEAD) + TAG_BYTES
_PURPOSE = b"noack connections"
_ADDRESS_BYTES = 16
_PROOF_S = 5.0
_HANDSHAKE_S = 5.0
_CLOSE_S = 5.0
"""Longest times for a proof of the key, for a handshake of TLS, and for closing a connection."""
_MOST_HANDSHAKES = 128
_MOST_CONNECTIONS = 64
"""Limits of handshakes and of connections at once."""
_READ_BYTES = 1 << 16
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]
OpenTarget = Callable[[], Awaitable[Streams]]
_FOLDER = "links"
_OPEN_S = 4.0
"""Longest time for a connection with the coordinator."""
_LONGEST_WAIT_S = 10.0
"""Time within which the first connection is tried again."""
_LINGER_S = 5.0
"""Longest time for which the program, at the end, sends what it has received."""
_PAUSE_S = 0.2
"""Time between two attempts to connect."""
_READY = b"ready\n"
_BACKLOG = 16
"""Connections that the kernel keeps until they are accepted."""
_REFUSED_TEXT = (
    "a program listens there, but does not accept this invitation; each run has a new one: copy "
    "that of the open run"
)
_NO_ROOM_TEXT = (
    "it had no room for this connection: other connections flood its port; start this process "
    "again, and see what `noack record` says about the flood"
)


class Answer(bytes, Enum):
    """The coordinator's answer to a proof."""

    ADMITTED = b"+"
    REFUSED = b"-"
    """The bytes are no proof for this connection under the key of this run."""
    NO_ROOM = b"*"
    """Too many connections wait; this one had not sent its proof."""


class InvitationProof:
    """Makes and checks proofs under the key of a run, which has 32 bytes."""

    def __init__(self, key: bytes) -> None:
        # A key of its own: the tags of datagrams are made with the run's key itself.
        self._tag = Tagger(hashlib.blake2b(_PURPOSE, key=key, digest_size=KEY_BYTES).digest())

    def make(self, own_address: tuple[str, int], coordinator: tuple[str, int]) -> bytes:
        """Return the proof for a connection; addresses are numeric."""
        return _HEAD + self._tag(_HEAD + _packed(own_address) + _packed(coordinator))

    def check(self, data: bytes, peer: tuple[str, int], own_address: tuple[str, int]) -> bool | None:
        """Whether bytes are the proof of the other end; None: a part of one may be there."""
        if not _HEAD.startswith(data[: len(_HEAD)]):
            return False
        if len(data) < PROOF_BYTES:
            return None
        return hmac.compare_digest(data, self.make(peer, own_address))


def _packed(address: tuple[str, int]) -> bytes:
    """Return an address as bytes of a fixed length; a scope is left out."""
    host = ipaddress.ip_address(address[0].partition("%")[0])
    return host.packed.ljust(_ADDRESS_BYTES, b"\0") + address[1].to_bytes(2, "big")


def tls_context(peer_certificate: str, certificate: str, private_key: str, *, server: bool) -> ssl.SSLContext:
    """Return the settings of one end, which accepts only the other end's certificate.

    Certificates and key are PEM text. ``server`` says whether this end is the coordinator.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=peer_certificate)
    with _file_in_memory(private_key + certificate) as path:
        context.load_cert_chain(path)
    return context


@contextmanager
def _file_in_memory(secret: str) -> Iterator[str]:
    """Give the path of a file with a text: ssl reads files only."""
    descriptor = os.memfd_create("tls", os.MFD_CLOEXEC)
    with os.fdopen(descriptor, "w") as file:
        file.write(secret)
        file.flush()
        yield f"/proc/self/fd/{descriptor}"


@dataclass(frozen=True)
class Protection:
    """Requirements of accepted connections."""

    context: ssl.SSLContext
    proof: InvitationProof
    unserved: Callable[[Counter[str]], None] = lambda count: None
    """Called every second: how many connections without a proof ended since, by host."""


def forwarding(
    listening: socket.socket,
    target: OpenTarget,
    protection: Protection | None = None,
    *,
    linger_s: float = 0.0,
) -> AbstractContextManager[asyncio.AbstractEventLoop]:
    """Forward each connection to a new connection with the target, within the context.

    The context yields the event loop in which ``target`` is called.

    Args:
        listening: a socket that listens; the caller closes it.
        target: opens a connection.
        protection: what accepted connections must have; None: bytes pass as they are.
        linger_s: at the end, how long what was received may still be forwarded.
    """
    forwarder = _Forwarder(target, protection)
    first = None
    if protection is not None:
        proof, own_address = protection.proof, listening.getsockname()
        first = FirstBytes(
            accept=lambda data, peer: proof.check(data, peer, own_address),
            most=PROOF_BYTES,
            within_s=_PROOF_S,
            refusal=Answer.REFUSED.value,
            no_room=Answer.NO_ROOM.value,
            report_unserved=protection.unserved,
        )
    return accepting(listening, forwarder.serve, first, name="forwarder", linger_s=linger_s)


class _Forwarder:
    """Treatment of accepted connections."""

    def __init__(self, target: OpenTarget, protection: Protection | None) -> None:
        self._target, self._protection = target, protection
        self._handshakes = TaskLimit(_MOST_HANDSHAKES)
        self._connections = TaskLimit(_MOST_CONNECTIONS, end_newest=True)

    async def serve(self, accepted: socket.socket, _: bytes, host: str) -> None:
        """Forward a connection until one end closes it."""
        if self._protection is not None:
            accepted.send(Answer.ADMITTED.value)
        connection = socket.socket(fileno=accepted.detach())
        with self._handshakes.count(host):
            reader, writer = await self._streams(connection)
        try:
            with self._connections.count(host):
                await self._forward(reader, writer)
        finally:
            writer.transport.abort()

    async def _streams(self, connection: socket.socket) -> Streams:
        loop, reader = asyncio.get_running_loop(), asyncio.StreamReader()
        protocol = asyncio.StreamReaderProtocol(reader)
        context = None if self._protection is None else self._protection.context
        transport, _ = await loop.connect_accepted_socket(
            lambda: protocol,
            connection,
            ssl=context,
            ssl_handshake_timeout=None if context is None else _HANDSHAKE_S,
        )
        return reader, asyncio.StreamWriter(transport, protocol, reader, loop)

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Copy both directions until one ends; what was received by then is sent."""
        loop = asyncio.get_running_loop()
        inner_reader, inner_writer = await self._target()
        copies = [
            loop.create_task(_copy(reader, inner_writer)),
            loop.create_task(_copy(inner_reader, writer)),
        ]
        try:
            await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.gather(_close(inner_writer), _close(writer))
        finally:
            for copy in copies:
                copy.cancel()
            inner_writer.transport.abort()


async def _close(writer: asyncio.StreamWriter) -> None:
    """Close a connection when everything is sent; with TLS, once the other end has agreed."""
    with suppress(OSError):  # TimeoutError is one
        async with asyncio.timeout(_CLOSE_S):
            writer.close()
            await writer.wait_closed()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_READ_BYTES):
            writer.write(data)
            await writer.drain()


class Destination(NamedTuple):
    """A coordinator's address, its certificate, and the keys of those that join, as PEM text.

    The run's key is in hexadecimal.
    """

    host: str
    port: int
    coordinator: str
    certificate: str
    private_key: str
    key: str


@contextmanager
def coordinator_link(destination: Destination) -> Iterator[str]:
    """Open a link within the context; yield the path of its Unix socket, for this process.

    Raise NoAnswerError if the coordinator cannot be reached, MachineError if the program cannot be
    started, CallerError if other users have access to the user's runtime directory.
    """
    with _unnamed_socket() as (listening, path):
        command = python_command("-m", __name__, listening.fileno())
        try:
            # In a session of its own, so that Ctrl-C does not end it before this process.
            program = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                pass_fds=[listening.fileno()],
                start_new_session=True,
            )
        except OSError as error:
            raise MachineError(f"cannot start the link to the coordinator: {why(error)}") from None
        assert program.stdin is not None
        assert program.stdout is not None
        with program:
            try:
                with suppress(BrokenPipeError):
                    program.stdin.write(json.dumps(destination).encode() + b"\n")
                    program.stdin.flush()
                answer = program.stdout.readline()
                if not answer:
                    raise MachineError("the link to the coordinator did not start")
                if answer != _READY:
                    raise NoAnswerError(answer.decode().strip())
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

    Raise NoAnswerError if that fails, and may succeed later; PeerError if that fails.
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
        raise PeerError(_REFUSED_TEXT) from None
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
            raise NoAnswerError(_NO_ROOM_TEXT)
        if answer == b"":
            raise ConnectionResetError
        if answer != Answer.ADMITTED:
            raise PeerError(_REFUSED_TEXT)
        context = tls_context(
            destination.coordinator, destination.certificate, destination.private_key, server=False
        )
        await writer.start_tls(context, server_hostname=destination.host)
    except BaseException:
        writer.transport.abort()
        raise
    return reader, writer


def _main() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends after the process that it serves
    destination = Destination(*json.loads(sys.stdin.buffer.readline()))
    prepared_streams: list[Streams] = []

    async def target() -> Streams:
        return prepared_streams.pop() if prepared_streams else await connect(destination)

    with (
        socket.socket(fileno=int(sys.argv[1])) as listening,
        forwarding(listening, target, linger_s=_LINGER_S) as loop,
        suppress(BrokenPipeError),  # the other process has ended
    ):
        opening = asyncio.run_coroutine_threadsafe(_connect_patiently(destination), loop)
        try:
            prepared_streams.append(opening.result())
        except PeerError as error:
            os.write(sys.stdout.fileno(), f"{error}\n".encode())
            return
        os.write(sys.stdout.fileno(), _READY)
        sys.stdin.buffer.read()  # ends when the other process closes it, or ends


async def _connect_patiently(destination: Destination) -> Streams:
    """Connect with the coordinator; try again while that may succeed later."""
    until_s = time.monotonic() + _LONGEST_WAIT_S
    while True:
        try:
            return await connect(destination)
        except NoAnswerError:
            if time.monotonic() > until_s:
                raise
            await asyncio.sleep(_PAUSE_S)


if __name__ == "__main__":
    _main()

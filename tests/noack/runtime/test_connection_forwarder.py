"""The forwarder: who gets through, also beside connections that stay half open."""

import asyncio
import socket
import ssl
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Literal, get_args

import pytest

from cosim.live.remote_access import KeyPair, TlsKeys, coordinator_context, new_tls_keys
from noack.runtime.connections import connection_gate, coordinator_link
from noack.runtime.connections.coordinator_link import (
    PROOF_BYTES,
    Answer,
    InvitationProof,
    Protection,
    forwarding,
)

KEYS = new_tls_keys("127.0.0.1")
PROOF = InvitationProof(bytes(32))
MESSAGE = bytes(range(256)) * 4000


@contextmanager
def echo() -> Iterator[socket.socket]:
    """Give a listening socket; what arrives on its connections is sent back."""

    async def back(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65_536):
                writer.write(data)
                await writer.drain()
        finally:
            writer.transport.abort()

    with socket.create_server(("127.0.0.1", 0)) as outer:

        async def to_itself() -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
            near, far = socket.socketpair()
            far_reader, far_writer = await asyncio.open_connection(sock=far)
            echoes.append(asyncio.create_task(back(far_reader, far_writer)))
            return await asyncio.open_connection(sock=near)

        echoes: list[asyncio.Task[None]] = []
        with forwarding(outer, to_itself, Protection(coordinator_context(KEYS), PROOF)):
            yield outer


def connected(
    address: tuple[str, int],
    keys: TlsKeys,
    own: KeyPair | None,
    plain: socket.socket | None = None,
) -> ssl.SSLSocket:
    """A connection with TLS, which has proved its invitation."""
    with ExitStack() as stack:
        plain = stack.enter_context(plain or socket.create_connection(address, timeout=60))
        plain.sendall(PROOF.make(plain.getsockname(), address))
        assert plain.recv(1) == Answer.ADMITTED
        connection = handshake(plain, keys, own)
        stack.pop_all()
    return connection


def handshake(plain: socket.socket, keys: TlsKeys, own: KeyPair | None) -> ssl.SSLSocket:
    context = ssl.create_default_context(cadata=keys.coordinator.certificate)
    if own is not None:
        with tempfile.TemporaryDirectory() as folder:
            (path := Path(folder) / "own.pem").write_text(own.private_key + own.certificate)
            context.load_cert_chain(path)
    return context.wrap_socket(plain, server_hostname="127.0.0.1")


def echoed(connection: socket.socket, message: bytes) -> bytes:
    connection.settimeout(60)
    connection.sendall(message)
    found = b""
    while len(found) < len(message) and (part := connection.recv(65_536)):
        found += part
    return found


Kind = Literal["connect", "garbage", "half a proof", "a foreign proof"]


@pytest.mark.parametrize("kind", get_args(Kind))
@pytest.mark.parametrize("addresses", [1, 200])
def test_a_flood_keeps_nobody_out(
    monkeypatch: pytest.MonkeyPatch, kind: Kind, addresses: int
) -> None:
    """The flood fills all places between any two steps of one who joins, from his address too."""
    monkeypatch.setattr(connection_gate, "_MOST_WAITING", 64)
    monkeypatch.setattr(connection_gate, "_ROOM", 16)
    monkeypatch.setattr(coordinator_link, "_PROOF_S", 3600.0)
    foreign = InvitationProof(b"\1" * 32)
    with echo() as listening, ExitStack() as stack:
        address = listening.getsockname()

        def flood(count: int) -> None:
            for number in range(count):
                host = f"127.0.{number % addresses}.1"
                one = socket.create_connection(address, timeout=60, source_address=(host, 0))
                stack.enter_context(closing(one))
                proof = foreign.make(one.getsockname(), address)
                sent = {"connect": b"", "garbage": b"\x16\3\1" * 100, "half a proof": proof[:10]}
                with suppress(ConnectionError):
                    one.sendall(sent.get(kind, proof))

        flood(100)
        with socket.create_connection(address, timeout=60) as plain:
            plain.sendall(PROOF.make(plain.getsockname(), address))
            flood(100)
            assert plain.recv(1) == Answer.ADMITTED
            flood(100)
            connection = stack.enter_context(handshake(plain, KEYS, KEYS.joining))
            flood(100)
            assert echoed(connection, MESSAGE[:1000]) == MESSAGE[:1000]


def test_a_flood_of_one_host_does_not_end_a_slow_connection_of_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(coordinator_link, "_PROOF_S", 3600.0)
    monkeypatch.setattr(connection_gate, "_MOST_WAITING", 64)
    monkeypatch.setattr(connection_gate, "_ROOM", 16)
    with echo() as listening, ExitStack() as stack:
        address = listening.getsockname()

        def begun(host: str) -> socket.socket:
            one = socket.create_connection(address, timeout=60, source_address=(host, 0))
            return stack.enter_context(closing(one))

        first = begun("127.0.0.3")
        crowd = [begun("127.0.0.2") for _ in range(200)]
        assert crowd[0].recv(1) == Answer.NO_ROOM
        with connected(address, KEYS, KEYS.joining, first) as connection:
            assert echoed(connection, MESSAGE[:1000]) == MESSAGE[:1000]


def test_a_proof_is_for_its_connection_only() -> None:
    with echo() as listening:
        address = listening.getsockname()
        with socket.create_connection(address, timeout=60) as one:
            proof = PROOF.make(one.getsockname(), address)
            with socket.create_connection(address, timeout=60) as other:
                other.sendall(proof)
                assert other.recv(1) == Answer.REFUSED
            for at in range(PROOF_BYTES):  # it may arrive in parts
                one.sendall(proof[at : at + 1])
            assert one.recv(1) == Answer.ADMITTED


def test_without_a_proof_a_connection_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coordinator_link, "_PROOF_S", 0.0)
    monkeypatch.setattr(connection_gate, "_CHECK_S", 0.01)
    with (
        echo() as listening,
        socket.create_connection(listening.getsockname(), timeout=60) as silent,
    ):
        assert silent.recv(1) == b""


def test_connections_that_one_host_holds_keep_no_other_host_out() -> None:
    with echo() as listening, ExitStack() as stack:
        address = listening.getsockname()

        def held(host: str) -> ssl.SSLSocket:
            plain = socket.create_connection(address, timeout=60, source_address=(host, 0))
            return stack.enter_context(connected(address, KEYS, KEYS.joining, plain))

        crowd = [held("127.0.0.2") for _ in range(64)]
        assert echoed(crowd[-1], b"hello") == b"hello"
        assert echoed(held("127.0.0.3"), b"hello") == b"hello"
        assert echoed(crowd[0], b"hello") == b"hello"  # the newest was ended


@pytest.mark.parametrize("own", [None, new_tls_keys("127.0.0.1").joining, KEYS.coordinator])
def test_without_a_certificate_of_the_run_nothing_passes(own: KeyPair | None) -> None:
    """With TLS 1.3 a client learns that it was refused when it reads."""
    with echo() as listening:
        with (
            suppress(ssl.SSLError, ConnectionError),
            connected(listening.getsockname(), KEYS, own) as connection,
        ):
            assert echoed(connection, b"hello") == b""
        with connected(listening.getsockname(), KEYS, KEYS.joining) as connection:
            assert echoed(connection, b"hello") == b"hello"


def test_a_coordinator_of_another_run_is_refused() -> None:
    with echo() as listening, pytest.raises(ssl.SSLCertVerificationError):
        connected(listening.getsockname(), new_tls_keys("127.0.0.1"), KEYS.joining)


def test_what_was_sent_before_the_end_arrives_at_a_slow_target() -> None:
    near, far = socket.socketpair()

    async def slow() -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection(sock=near)

    with (
        socket.create_server(("127.0.0.1", 0)) as listening,
        forwarding(listening, slow),
        closing(far),
    ):
        far.settimeout(60)
        with socket.create_connection(listening.getsockname(), timeout=60) as connection:
            connection.sendall(MESSAGE)
        found = b""
        while part := far.recv(4096):
            found += part
            time.sleep(0.001)
        assert found == MESSAGE

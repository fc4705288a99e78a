"""The link to a coordinator on another host: the proof of invitation, who gets through or not.

The forwarder is tested beside connections that stay half open; the proof is that of docs/wire.md.
"""

import asyncio
import hashlib
import socket
import ssl
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress

import pytest

from cosim.live.coordination.remote_access import KeyPair, TlsKeys, coordinator_context, new_tls_keys
from noack.core.errors import NoAnswerError, PeerError
from noack.runtime.address import Address
from noack.runtime.connections import connection_gate
from noack.runtime.connections import coordinator_link as link_module
from noack.runtime.connections.coordinator_link import (
    PROOF_BYTES,
    Answer,
    Destination,
    InvitationProof,
    Protection,
    Streams,
    connect,
    coordinator_link,
    forwarding,
    tls_context,
)

KEYS, OTHER_KEYS, KEY = new_tls_keys("127.0.0.1"), new_tls_keys("127.0.0.1"), bytes(range(32))
PROOF = InvitationProof(KEY)
PROTECTION = Protection(coordinator_context(KEYS), PROOF)
OWN, COORDINATOR = ("192.0.2.7", 40_000), ("192.0.2.1", 7400)


@pytest.mark.parametrize(
    ("own", "coordinator"),
    [(OWN, COORDINATOR), (("2001:db8::7", 40_000), ("2001:db8::1", 7400))],
)
def test_the_proof_has_the_documented_layout(own: Address, coordinator: Address) -> None:
    derived = hashlib.blake2b(b"noack connections", key=KEY, digest_size=32).digest()
    content = b"NJ\1\0"
    for host, port in (own, coordinator):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        content += socket.inet_pton(family, host).ljust(16, b"\0") + port.to_bytes(2, "big")
    tag = hashlib.blake2b(content, key=derived, digest_size=16).digest()
    assert PROOF.make(own, coordinator) == b"NJ\1\0" + tag
    assert PROOF.check(b"NJ\1\0" + tag, own, coordinator)


def test_the_proof_is_refused_at_the_first_wrong_byte_and_for_any_other_connection() -> None:
    proof = PROOF.make(OWN, COORDINATOR)
    assert len(proof) == PROOF_BYTES
    for length in range(PROOF_BYTES):
        assert PROOF.check(proof[:length], OWN, COORDINATOR) is None
    for at in range(PROOF_BYTES):
        changed = bytearray(proof)
        changed[at] ^= 1
        assert PROOF.check(bytes(changed), OWN, COORDINATOR) is False
    for other in (("192.0.2.8", 40_000), ("192.0.2.7", 40_001)):
        assert PROOF.check(proof, other, COORDINATOR) is False
    assert PROOF.check(proof, COORDINATOR, OWN) is False
    assert InvitationProof(bytes(32)).check(proof, OWN, COORDINATOR) is False


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as endpoint:
        yield endpoint


def destination(endpoint: socket.socket, keys: TlsKeys = KEYS, key: bytes = KEY) -> Destination:
    host, port = endpoint.getsockname()
    return Destination(host, port, keys.coordinator.certificate, *keys.joining, key.hex())


def reason(to: Destination) -> str:
    with pytest.raises(PeerError) as caught:
        asyncio.run(connect(to))
    return str(caught.value)


async def nowhere() -> Streams:
    raise ConnectionError


def unix_socket(path: str) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(60)
    connection.connect(path)
    return connection


def test_a_port_where_nothing_listens_is_named() -> None:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        assert reason(destination(bound)).startswith("nothing listens there")
        with (
            pytest.raises(NoAnswerError, match="nothing listens there"),
            coordinator_link(destination(bound)),
        ):
            pass


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (Answer.NO_ROOM.value, "it had no room for this connection: other connections flood"),
        (b"", "it closed the connection without an answer; has `noack record` just"),
        (b"HTTP/1.1 400", "a program listens there, but does not accept this invitation"),
    ],
)
def test_a_connection_that_ends_before_its_handshake_is_reported_with_its_cause(
    listening: socket.socket, answer: bytes, text: str
) -> None:
    def end_it() -> None:
        connection, _ = listening.accept()
        with connection:
            connection.recv(100)
            connection.sendall(answer)

    thread = threading.Thread(target=end_it)
    thread.start()
    assert reason(destination(listening)).startswith(text)
    thread.join()


@pytest.mark.parametrize("other", [{"key": b"\1" * 32}, {"keys": OTHER_KEYS}])
def test_a_run_with_another_key_refuses_the_invitation(
    listening: socket.socket, other: dict[str, object]
) -> None:
    with forwarding(listening, nowhere, PROTECTION):
        why = reason(destination(listening, **other))  # type: ignore[arg-type]
    assert "does not accept this invitation" in why


def test_a_host_without_answer_is_named(monkeypatch: pytest.MonkeyPatch, listening: socket.socket) -> None:
    monkeypatch.setattr(link_module, "_OPEN_S", 0.01)
    assert reason(destination(listening)).startswith("no answer; is it the recording host's")


def test_the_link_tries_again_while_there_is_no_room(listening: socket.socket) -> None:
    """Then it forwards the first connection by the one that it has."""
    near, far = socket.socketpair()

    async def target() -> Streams:
        return await asyncio.open_connection(sock=near)

    def turn_away_then_admit() -> None:
        connection, _ = listening.accept()
        with connection:
            connection.recv(100)
            connection.sendall(Answer.NO_ROOM.value)
        with forwarding(listening, target, PROTECTION):
            assert far.recv(100) == b"hello"
            far.sendall(b"hello to you")
            assert far.recv(100) == b""

    far.settimeout(60)
    with far, ThreadPoolExecutor() as pool:
        admitted = pool.submit(turn_away_then_admit)
        with coordinator_link(destination(listening)) as path, unix_socket(path) as connection:
            connection.sendall(b"hello")
            assert connection.recv(100) == b"hello to you"
        admitted.result()


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

    async def to_itself() -> Streams:
        near, far = socket.socketpair()
        far_reader, far_writer = await asyncio.open_connection(sock=far)
        echoes.append(asyncio.create_task(back(far_reader, far_writer)))
        return await asyncio.open_connection(sock=near)

    echoes: list[asyncio.Task[None]] = []
    with (
        socket.create_server(("127.0.0.1", 0)) as outer,
        forwarding(outer, to_itself, PROTECTION),
    ):
        yield outer


def handshake(plain: socket.socket, own: KeyPair = KEYS.joining) -> ssl.SSLSocket:
    context = tls_context(KEYS.coordinator.certificate, *own, server=False)
    return context.wrap_socket(plain, server_hostname="127.0.0.1")


def connected(address: Address, host: str = "", own: KeyPair = KEYS.joining) -> ssl.SSLSocket:
    """A connection with TLS, which has proved its invitation."""
    plain = socket.create_connection(address, timeout=60, source_address=(host, 0))
    plain.sendall(PROOF.make(plain.getsockname(), address))
    assert plain.recv(1) == Answer.ADMITTED
    return handshake(plain, own)


def echoed(connection: socket.socket, message: bytes = b"hello") -> bytes:
    connection.settimeout(60)
    connection.sendall(message)
    received = b""
    while len(received) < len(message) and (part := connection.recv(65_536)):
        received += part
    return received


@pytest.mark.parametrize("kind", ["connect", "garbage", "half a proof", "a foreign proof"])
@pytest.mark.parametrize("addresses", [1, 200])
def test_a_flood_keeps_no_process_from_joining(
    monkeypatch: pytest.MonkeyPatch, kind: str, addresses: int
) -> None:
    """The flood fills all places between any two steps of one who joins, from his address too."""
    monkeypatch.setattr(connection_gate, "_MOST_WAITING", 64)
    monkeypatch.setattr(connection_gate, "_ROOM", 16)
    monkeypatch.setattr(link_module, "_PROOF_S", 3600.0)
    foreign = InvitationProof(b"\1" * 32)
    with echo() as listening, ExitStack() as stack:
        address = listening.getsockname()

        def flood(count: int) -> None:
            for number in range(count):
                host = f"127.0.{number % addresses}.1"
                connection = socket.create_connection(address, timeout=60, source_address=(host, 0))
                stack.enter_context(closing(connection))
                proof = foreign.make(connection.getsockname(), address)
                sent = {"connect": b"", "garbage": b"\x16\3\1" * 100, "half a proof": proof[:10]}
                with suppress(ConnectionError):
                    connection.sendall(sent.get(kind, proof))

        flood(100)
        with socket.create_connection(address, timeout=60) as plain:
            plain.sendall(PROOF.make(plain.getsockname(), address))
            flood(100)
            assert plain.recv(1) == Answer.ADMITTED
            flood(100)
            connection = stack.enter_context(handshake(plain))
            flood(100)
            message = bytes(range(250)) * 4
            assert echoed(connection, message) == message


def test_without_a_proof_a_connection_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "_PROOF_S", 0.0)
    monkeypatch.setattr(connection_gate, "_CHECK_S", 0.01)
    with (
        echo() as listening,
        socket.create_connection(listening.getsockname(), timeout=60) as silent,
    ):
        assert silent.recv(1) == b""


def test_connections_that_one_host_holds_keep_no_other_host_out() -> None:
    with echo() as listening, ExitStack() as stack:
        address = listening.getsockname()
        crowd = [stack.enter_context(connected(address, "127.0.0.2")) for _ in range(64)]
        assert echoed(crowd[-1]) == b"hello"
        assert echoed(stack.enter_context(connected(address, "127.0.0.3"))) == b"hello"
        assert echoed(crowd[0]) == b"hello"  # the newest was ended


@pytest.mark.parametrize("own", [OTHER_KEYS.joining, KEYS.coordinator])
def test_without_a_certificate_of_the_run_nothing_passes(own: KeyPair) -> None:
    """With TLS 1.3 a client learns that it was refused when it reads."""
    with echo() as listening:
        with (
            suppress(ssl.SSLError, ConnectionError),
            connected(listening.getsockname(), own=own) as connection,
        ):
            assert echoed(connection) == b""
        with connected(listening.getsockname()) as connection:
            assert echoed(connection) == b"hello"

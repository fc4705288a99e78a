"""The forwarder: who gets through, also beside connections that stay half open."""

import asyncio
import socket
import ssl
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import pytest

from cosim.live.tls_keys import KeyPair, TlsKeys, coordinator_context, new_tls_keys
from noack.runtime.connection_forwarder import forwarding

KEYS = new_tls_keys("127.0.0.1")
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
        with forwarding(outer, to_itself, coordinator_context(KEYS)):
            yield outer


def connected(
    address: tuple[str, int],
    keys: TlsKeys,
    own: KeyPair | None,
    plain: socket.socket | None = None,
) -> ssl.SSLSocket:
    context = ssl.create_default_context(cadata=keys.authority)
    if own is not None:
        with tempfile.TemporaryDirectory() as folder:
            (path := Path(folder) / "own.pem").write_text(own.private_key + own.certificate)
            context.load_cert_chain(path)
    with ExitStack() as stack:
        plain = stack.enter_context(plain or socket.create_connection(address, timeout=60))
        connection = context.wrap_socket(plain, server_hostname="127.0.0.1")
        stack.pop_all()
    return connection


def echoed(connection: socket.socket, message: bytes) -> bytes:
    connection.settimeout(60)
    connection.sendall(message)
    found = b""
    while len(found) < len(message) and (part := connection.recv(65_536)):
        found += part
    return found


def test_bytes_pass_beside_a_crowd_of_half_open_connections() -> None:
    with echo() as listening, ExitStack() as stack:
        address = listening.getsockname()
        for number in range(300):
            one = stack.enter_context(closing(socket.create_connection(address, timeout=60)))
            if number % 3 == 0:
                one.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with connected(address, KEYS, KEYS.joining) as connection:
            assert connection.version() == "TLSv1.3"
            assert echoed(connection, MESSAGE[:1000]) == MESSAGE[:1000]


def test_a_crowd_of_one_host_does_not_end_the_handshake_of_another() -> None:
    with echo() as listening, ExitStack() as stack:
        address = listening.getsockname()

        def begun(host: str) -> socket.socket:
            one = socket.create_connection(address, timeout=60, source_address=(host, 0))
            return stack.enter_context(closing(one))

        first = begun("127.0.0.3")
        crowd = [begun("127.0.0.2") for _ in range(300)]
        assert crowd[100].recv(1) == b""  # so many were ended
        with connected(address, KEYS, KEYS.joining, first) as connection:
            assert echoed(connection, MESSAGE[:1000]) == MESSAGE[:1000]


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


def test_a_long_message_passes_unchanged() -> None:
    with echo() as listening, connected(listening.getsockname(), KEYS, KEYS.joining) as connection:
        for at in range(0, len(MESSAGE), 32_000):
            assert echoed(connection, MESSAGE[at : at + 32_000]) == MESSAGE[at : at + 32_000]


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

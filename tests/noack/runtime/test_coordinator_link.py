"""Why a coordinator on another host is not reached, and what the link to it forwards."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from cosim.live.remote_access import TlsKeys, coordinator_context, new_tls_keys
from noack.core.errors import NoAnswerError, PeerError
from noack.runtime.connections import coordinator_link as link_module
from noack.runtime.connections.coordinator_link import (
    Answer,
    Destination,
    InvitationProof,
    Protection,
    Streams,
    connect,
    coordinator_link,
    forwarding,
)

KEYS, KEY = new_tls_keys("127.0.0.1"), bytes(32)


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
    one = socket.socket(socket.AF_UNIX)
    one.settimeout(60)
    one.connect(path)
    return one


def protection() -> Protection:
    return Protection(coordinator_context(KEYS), InvitationProof(KEY))


def test_a_port_where_nothing_listens() -> None:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        assert reason(destination(bound)).startswith("nothing listens there")


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (Answer.NO_ROOM.value, "it had no room for this connection: other connections flood"),
        (b"", "it closed the connection without an answer; has `noack record` just"),
        (b"HTTP/1.1 400", "a program listens there, but does not accept this invitation"),
    ],
)
def test_a_connection_that_ends_before_its_handshake(
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


def test_a_run_with_another_key(listening: socket.socket) -> None:
    with forwarding(listening, nowhere, protection()):
        found = reason(destination(listening, key=b"\1" * 32))
    assert "does not accept this invitation" in found


def test_a_coordinator_with_other_certificates(listening: socket.socket) -> None:
    with forwarding(listening, nowhere, protection()):
        found = reason(destination(listening, keys=new_tls_keys("127.0.0.1")))
    assert "does not accept this invitation" in found


def test_no_answer(monkeypatch: pytest.MonkeyPatch, listening: socket.socket) -> None:
    monkeypatch.setattr(link_module, "_OPEN_S", 0.01)
    assert reason(destination(listening)).startswith("no answer; is it the recording host's")


def test_what_was_sent_before_the_end_arrives(listening: socket.socket) -> None:
    """The link sends on what it has received when the process closes its end."""
    message = bytes(range(256)) * 20_000
    near, far = socket.socketpair()

    async def target() -> Streams:
        return await asyncio.open_connection(sock=near)

    found = b""
    with forwarding(listening, target, protection()), far:
        far.settimeout(60)

        def send() -> None:
            with coordinator_link(destination(listening)) as path, unix_socket(path) as one:
                one.sendall(message)

        thread = threading.Thread(target=send)
        thread.start()
        with suppress(ConnectionResetError):
            while part := far.recv(4096):
                found += part
        thread.join()
    assert found == message


def test_the_link_reports_why_it_fails() -> None:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        with (
            pytest.raises(NoAnswerError, match="nothing listens there"),
            coordinator_link(destination(bound)),
        ):
            pass


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
        with forwarding(listening, target, protection()):
            assert far.recv(100) == b"hello"
            far.sendall(b"hello to you")
            assert far.recv(100) == b""

    far.settimeout(60)
    with far, ThreadPoolExecutor() as pool:
        admitted = pool.submit(turn_away_then_admit)
        with coordinator_link(destination(listening)) as path, unix_socket(path) as one:
            one.sendall(b"hello")
            assert one.recv(100) == b"hello to you"
        admitted.result()

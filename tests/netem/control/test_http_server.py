"""The servers of live control: limits of a connection, stalled clients, the token of a port."""

import json
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from http import HTTPStatus
from pathlib import Path

import pytest

from netem.control import command_queue, http_server
from netem.control.command_queue import CommandQueue
from netem.control.control_server import TOKEN_VARIABLE, ControlAddresses, TcpAccess, control_server
from netem.control.http_server import BODY_BYTES, CONNECTIONS, HEAD_BYTES
from netem.core.errors import CallerError
from netem.impairments.link_settings import LinkSettings
from netem.tc_words import settings_of
from tests.helpers.waiting import wait_for
from tests.netem.control.fake_relay import FakeRelay, options
from tests.netem.control.http_requests import Answered, request, send, tcp, unix

TOKEN = "0123456789abcdef"


@pytest.fixture(autouse=True)
def no_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)


@pytest.fixture
def port(commands: CommandQueue, monkeypatch: pytest.MonkeyPatch) -> Iterator[ControlAddresses]:
    """The control server of an emulator that listens on a port, with a token."""
    monkeypatch.setenv(TOKEN_VARIABLE, TOKEN)
    with control_server("lab", commands, TcpAccess(0)) as addresses:
        yield addresses


def host_of(addresses: ControlAddresses) -> str:
    return str(addresses.url).removeprefix("http://")


def ask(addresses: ControlAddresses, **headers: str) -> Answered:
    given = {"Host": host_of(addresses), "Authorization": f"Bearer {TOKEN}"} | headers
    return request(tcp(addresses), "GET", "/links", **given)


@pytest.mark.parametrize(
    ("data", "status", "error"),
    [
        (b"GET /links HTTP/1.1\r\nContent-Length: -1\r\n\r\n", 400, "Content-Length: -1; expected one"),
        (b"GET /links HTTP/1.1\r\nContent-Length: \r\n\r\n", 400, "header Content-Length: ; expected one"),
        (b"GET /links HTTP/1.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n", 400, ": 1, 2; expected"),
        (b"GET /links HTTP/1.1\r\nContent-Length: 4194305\r\n\r\n", 413, "the body has 4194305 bytes; at"),
        (b"GET /links HTTP/1.1\r\nContent-Length: " + 400 * b"9" + b"\r\n\r\n", 413, "the body has 999"),
        (b"GET /links HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n", 411, "send the body with Content-Len"),
        (b"GET /links HTTP/1.1\r\n" + 101 * b"a: b\r\n" + b"\r\n", 431, "Too many headers"),
        (b"GET /links HTTP/1.1\r\nX: " + 2 * HEAD_BYTES * b"x" + b"\r\n\r\n", 431, "at most 16,384 bytes"),
        (b"GET /" + 2 * HEAD_BYTES * b"x", 431, "at most 16,384 bytes"),
        (b"\x16\x03\x01\r\n\r\n", 400, "Bad "),
        (b"GET /links HTTP/3.0\r\n\r\n", 505, "Invalid HTTP version"),
    ],
)  # fmt: skip
def test_a_request_beyond_a_limit_is_refused(
    server: ControlAddresses, data: bytes, status: int, error: str
) -> None:
    answer = send(unix(server), data)
    assert answer.status == status
    assert error in answer.document["error"]
    assert answer.headers["Connection"] == "close"


def test_a_body_that_ends_early_is_refused(relay: FakeRelay, server: ControlAddresses) -> None:
    with unix(server)() as connection:
        connection.sendall(b'PATCH /links/up HTTP/1.1\r\nContent-Length: 99\r\n\r\n{"forward": "loss 5%"}')
        connection.shutdown(socket.SHUT_WR)
        answer = connection.makefile("rb").read()
    assert b" 400 " in answer
    assert b"the body ended after 22 of 99 bytes" in answer
    assert relay.changes == 0


def test_a_body_as_long_as_permitted_is_read(relay: FakeRelay, server: ControlAddresses) -> None:
    body = '{"forward": "loss 5%"}'.ljust(BODY_BYTES)
    assert request(unix(server), "PATCH", "/links/up", body).status == 200
    assert relay.settings["up", "forward"] == settings_of("loss 5%")
    answer = request(unix(server), "PATCH", "/links/up", body + " ")
    assert (answer.status, relay.changes) == (413, 1)


def test_a_body_that_is_much_too_large_has_its_answer_too(server: ControlAddresses) -> None:
    """A client that reads after it has sent everything: the connection is not reset before."""
    length = 64 * 2**20
    head = b"PATCH /links/up HTTP/1.1\r\nContent-Length: %d\r\n\r\n" % length
    assert send(unix(server), head + bytes(length)).status == 413


def test_a_client_is_told_to_send_a_large_body(server: ControlAddresses) -> None:
    """curl waits for that before it sends one."""
    head = b"PATCH /links/up HTTP/1.1\r\nExpect: 100-continue\r\nContent-Length: %d\r\n\r\n"
    with unix(server)() as connection:
        connection.sendall(head % 22)
        assert connection.recv(1000) == b"HTTP/1.1 100 Continue\r\n\r\n"
        connection.sendall(b'{"forward": "loss 5%"}')
        assert b" 200 OK" in connection.makefile("rb").read()
    assert send(unix(server), head % (BODY_BYTES + 1)).status == 413


def test_stalled_clients_delay_neither_the_relay_nor_others(
    relay: FakeRelay, commands: CommandQueue, server: ControlAddresses
) -> None:
    """Clients that send nothing, half a head, half a body, and that do not read their answer."""
    starts = (
        b"",
        b"GET /li",
        b"PATCH /links/up HTTP/1.1\r\nContent-Length: 9\r\n\r\n{",
        b"GET /stats HTTP/1.1\r\n\r\n",
    )
    with ExitStack() as stack:
        for start in starts:
            stalled = stack.enter_context(unix(server)())
            stalled.sendall(start)
        for _ in range(10):
            assert request(unix(server), "GET", "/links").status == 200
            commands.snapshot()  # runs in the relay's thread
        assert request(unix(server), "PATCH", "/links/up", '{"reverse": "loss 5%"}').status == 200
    assert relay.changes == 1


def test_a_stalled_connection_ends(server: ControlAddresses, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also that of a client that sends a byte from time to time."""
    monkeypatch.setattr(http_server, "_REQUEST_S", 0.05)
    monkeypatch.setattr(http_server, "_REST_S", 0.05)
    with unix(server)() as stalled:
        assert stalled.recv(10) == b""
    slow = unix(server)()
    slow.settimeout(0.001)

    def is_open() -> bool:
        try:
            slow.sendall(b"a")
            return slow.recv(10) != b""
        except TimeoutError:
            return True
        except OSError:
            return False

    wait_for(lambda: not is_open())
    slow.close()


def test_many_clients_are_answered(server: ControlAddresses) -> None:
    with ThreadPoolExecutor(32) as threads:
        answers = threads.map(lambda _: request(unix(server), "GET", "/links").status, range(400))
        assert set(answers) == {200}


def test_connections_are_limited(server: ControlAddresses, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_server, "_BUSY_S", 0.01)
    with ExitStack() as stack:
        for _ in range(CONNECTIONS):
            stack.enter_context(unix(server)())
        answer = send(unix(server), b"GET /links HTTP/1.1\r\n\r\n")
        assert (answer.status, answer.document) == (
            503,
            {"error": f"{CONNECTIONS} connections are open; try again later"},
        )
    monkeypatch.setattr(http_server, "_BUSY_S", 60)
    assert request(unix(server), "GET", "/links").status == 200


def test_open_connections_are_closed_at_the_end(commands: CommandQueue) -> None:
    with control_server("lab", commands) as addresses:
        stalled = unix(addresses)()
        stalled.sendall(b"GET /")
        assert request(unix(addresses), "GET", "/links").status == 200
    with stalled:
        assert stalled.recv(10) == b""


def test_a_port_needs_the_token(port: ControlAddresses) -> None:
    assert ask(port).status == ask(port, Authorization=f"bearer  {TOKEN} ").status == 200
    assert ask(port, Host=host_of(port).replace("127.0.0.1", "LOCALHOST")).status == 200
    for wrong in (
        "",
        TOKEN,
        "Bearer",
        f"Bearer {TOKEN[:-1]}",
        f"Bearer {TOKEN}0",
        f"Basic {TOKEN}",
        "Bearer \xe9",
    ):
        answer = ask(port, Authorization=wrong)
        assert answer.status == HTTPStatus.UNAUTHORIZED
        assert answer.headers["WWW-Authenticate"].startswith("Bearer")
        assert "expected Bearer TOKEN" in answer.document["error"]
        assert TOKEN not in answer.text
    assert "header Authorization: missing" in request(tcp(port), "GET", "/", Host=host_of(port)).text
    assert request(unix(port), "GET", "/links").status == 200  # the socket is its user's


def test_a_port_answers_no_web_page(relay: FakeRelay, port: ControlAddresses) -> None:
    """Neither one that sends a request to it, nor one whose name was rebound to 127.0.0.1."""
    for host in (
        "evil.example",
        host_of(port).replace("127.0.0.1", "evil.example"),
        "127.0.0.1",
        "127.0.0.1:1",
    ):
        answer = ask(port, Host=host)
        assert (answer.status, answer.document) == (
            403,
            {"error": f"header Host: {host}; expected {host_of(port)}"},
        )
    answer = ask(port, Origin="http://evil.example")
    assert answer.status == 403
    assert "requests of web pages are refused" in answer.document["error"]
    token = f"Authorization: Bearer {TOKEN}\r\n".encode()
    host = f"Host: {host_of(port)}\r\n".encode()
    for headers in (b"", host + host, host + b"Host: a\r\n"):
        assert send(tcp(port), b"GET /links HTTP/1.1\r\n" + token + headers + b"\r\n").status == 403
    body = b'{"forward": "loss 5%"}'
    head = b"PATCH /links/up HTTP/1.1\r\nContent-Length: 22\r\n"
    assert send(tcp(port), head + host + b"\r\n" + body).status == 401
    assert relay.changes == 0
    assert send(tcp(port), head + host + token + b"\r\n" + body).status == 200


def test_a_token_is_made_for_each_start(commands: CommandQueue) -> None:
    tokens = set()
    for _ in range(2):
        with control_server("lab", commands, TcpAccess(0)) as addresses:
            assert addresses.token_file is not None
            assert addresses.token_file.stat().st_mode & 0o777 == 0o600
            token = addresses.token_file.read_text().strip()
            assert ask(addresses, Authorization=f"Bearer {token}").status == 200
            tokens.add(token)
            document = json.dumps(addresses.document()) + "".join(addresses.lines())
            assert token not in document
            assert str(addresses.token_file) in document
        assert not addresses.token_file.exists()
    assert len(tokens) == 2
    assert min(map(len, tokens)) >= 43  # 256 bits


def test_a_token_comes_from_a_file_before_the_environment(
    commands: CommandQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, "another token")
    (file := tmp_path / "token").write_text(f"{TOKEN}\n")
    with control_server("lab", commands, TcpAccess(0, file)) as addresses:
        assert addresses.token_file is None
        assert ask(addresses).status == 200


def test_a_wrong_token_or_port_is_refused_at_the_start(
    commands: CommandQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (short := tmp_path / "short").write_text("0123")
    gone = tmp_path / "gone"
    needs = "a token has 16 to 256 letters, digits and signs, without spaces"
    cases = {
        short: f"--control-token {short}: {needs}",
        gone: f"--control-token {gone}: cannot be read: No such file or directory",
    }
    for file, line in cases.items():
        with pytest.raises(CallerError) as error, control_server("lab", commands, TcpAccess(0, file)):
            pass
        assert str(error.value) == line
    monkeypatch.setenv(TOKEN_VARIABLE, "a b")
    with pytest.raises(CallerError, match=f"NOACK_NETEM_TOKEN: {needs}"):
        control_server("lab", commands, TcpAccess(0)).__enter__()
    monkeypatch.delenv(TOKEN_VARIABLE)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        with (
            pytest.raises(
                CallerError, match=f"--control-port {number}: Address already in use; choose another"
            ),
            control_server("lab", commands, TcpAccess(number)),
        ):
            pass


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--control-port 0", "--control-port 0: also needs --control NAME"),
        ("--control lab --control-token f", "--control-token f: also needs --control-port PORT"),
        ("--control lab --control-port 65536", "--control-port 65536: expected 0 to 65535"),
        ("--control lab --control-port -1", "--control-port -1: expected 0 to 65535"),
    ],
)
def test_options_of_a_port_belong_together(words: str, line: str) -> None:
    with pytest.raises(CallerError, match=line):
        options(*words.split())


def test_the_words_of_settings_are_written_once(
    server: ControlAddresses, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a table with 250,000 delays take seconds of the processor, which the relay needs, too."""
    written: list[LinkSettings] = []

    def words(settings: LinkSettings) -> str:
        written.append(settings)
        return "words"

    monkeypatch.setattr(command_queue, "words_of", words)
    for path in ("/links", "/links", "/links/up", "/stats"):
        assert request(unix(server), "GET", path).status == 200
    assert len(written) == 4  # of two links, in two directions

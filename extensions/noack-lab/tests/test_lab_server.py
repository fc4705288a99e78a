"""Whom the page's server answers, and how it opens the browser."""

import asyncio
import stat
from collections.abc import MutableMapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import uvicorn

from noack_lab import lab_page
from noack_lab.connections import MOST_STRANGERS, Strangers, limited_protocol
from noack_lab.lab_server import AddressGuard, opening_page

SECRET = "s" * 43


def answer(kind: str, path: str, **headers: str) -> MutableMapping[str, Any]:
    """What a request is answered with."""
    sent: list[MutableMapping[str, Any]] = []

    async def inner(scope: Any, receive: Any, send: Any) -> None:
        assert scope["root_path"] == f"/{SECRET}"
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def receive() -> MutableMapping[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    encoded_headers = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": kind, "path": path, "headers": encoded_headers, "query_string": b""}
    asyncio.run(AddressGuard(inner, SECRET, Strangers())(scope, receive, send))
    return sent[0]


OWN = f"/{SECRET}/"
HOST = {"host": "127.0.0.1:8765"}


@pytest.mark.parametrize(
    ("kind", "path", "headers", "status"),
    [
        ("http", OWN, HOST, 200),
        ("http", "/", HOST, 404),
        ("http", f"/{SECRET[:-1]}/", HOST, 404),
        ("http", f"/{SECRET}x/", HOST, 404),
        ("http", OWN, {}, 403),
        ("http", OWN, {"host": "evil.example:8765"}, 403),
        ("http", OWN, {"host": "127.0.0.1.evil.example"}, 403),
        ("http", OWN, HOST | {"origin": "http://evil.example"}, 403),
        ("http", OWN, HOST | {"origin": "http://127.0.0.1:9999"}, 403),
        ("http", OWN, HOST | {"origin": "null"}, 403),
        ("websocket", OWN, HOST, None),
        ("websocket", OWN, HOST | {"origin": "http://evil.example"}, None),
        ("websocket", "/", HOST | {"origin": "http://127.0.0.1:8765"}, None),
    ],
)
def test_only_the_page_itself_is_answered(
    kind: str, path: str, headers: dict[str, str], status: int | None
) -> None:
    first = answer(kind, path, **headers)
    assert first.get("status") == status
    assert (first["type"] == "websocket.close") == (status is None)
    if status == 200:
        names = {name for name, _ in first["headers"]}
        assert {b"content-security-policy", b"x-frame-options", b"referrer-policy"} <= names


def test_the_browser_is_given_a_file_that_only_this_user_reads(tmp_path: Path) -> None:
    """Every user can read command lines."""
    path = opening_page(tmp_path, "http://127.0.0.1:1/secret/")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert "url=http://127.0.0.1:1/secret/" in path.read_text()


@pytest.mark.parametrize("has_left", [False, True])
def test_nothing_is_computed_for_a_visitor_who_never_connects(
    has_left: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that only asks for the page: the page's client is deleted while it waits."""
    opened: list[Any] = []

    async def connected() -> None:
        client.is_deleted = has_left

    async def show(draft: Any) -> None:
        opened.append(draft)

    ignored: Any = lambda *_, **__: None  # noqa: E731
    client = SimpleNamespace(connected=connected, is_deleted=False, run_javascript=ignored)
    context = SimpleNamespace(client=client)
    monkeypatch.setattr(lab_page, "ui", SimpleNamespace(add_css=ignored, colors=ignored, context=context))
    monkeypatch.setattr(lab_page, "_Page", lambda _: SimpleNamespace(build=ignored, open=show))
    asyncio.run(lab_page.show_page(SimpleNamespace(draft="draft")))  # type: ignore[arg-type]
    assert opened == ([] if has_left else ["draft"])


async def _page(scope: Any, receive: Any, send: Any) -> None:
    headers = [(b"content-length", b"4")]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": b"page"})


async def flooded(idle_connections: int) -> tuple[list[bytes], int, int]:
    """Serve a page while connections of strangers are idle; return answers, strangers, open ones."""
    strangers = Strangers()
    config = uvicorn.Config(
        AddressGuard(_page, SECRET, strangers), http=limited_protocol(strangers), lifespan="off", port=0,
        log_level="warning",
    )  # fmt: skip
    server = uvicorn.Server(config)
    serving = asyncio.create_task(server.serve())
    while not server.started:
        await asyncio.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    request = f"GET {OWN} HTTP/1.1\r\nhost: 127.0.0.1:{port}\r\n\r\n".encode()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)  # the page's, kept open
    answers = list[bytes]()
    writer.write(request)
    answers.append(await reader.readuntil(b"page"))
    idle = [await asyncio.open_connection("127.0.0.1", port) for _ in range(idle_connections)]
    while len(server.server_state.connections) > MOST_STRANGERS + 1:
        await asyncio.sleep(0.01)
    writer.write(request)
    answers.append(await reader.readuntil(b"page"))
    counts = len(strangers), len(server.server_state.connections)
    for _, other in [*idle, (reader, writer)]:
        other.close()
    server.should_exit = True
    await serving
    return answers, *counts


def test_idle_connections_of_others_take_a_bounded_number_of_descriptors(
    capfd: pytest.CaptureFixture[str],
) -> None:
    answers, strangers, connections = asyncio.run(flooded(200))
    assert [text[:15] for text in answers] == [b"HTTP/1.1 200 OK"] * 2
    assert strangers <= MOST_STRANGERS
    assert connections <= MOST_STRANGERS + 1
    assert "Traceback" not in capfd.readouterr().err


def test_a_connection_without_a_request_has_some_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("noack_lab.connections.ADMITTED_WITHIN_S", 0.05)
    aborted = list[bool]()

    class Transport:
        def abort(self) -> None:
            aborted.append(True)

    async def wait() -> None:
        strangers = Strangers()
        strangers.came(("127.0.0.1", 1), cast(Any, Transport()))
        strangers.came(("127.0.0.1", 2), cast(Any, Transport()))
        strangers.forget(("127.0.0.1", 2))  # admitted
        while len(strangers):
            await asyncio.sleep(0.01)

    asyncio.run(wait())
    assert aborted == [True]

"""Whom the page's server answers, and how it opens the browser."""

import asyncio
import stat
from collections.abc import MutableMapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from noack_lab import lab_page
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
    asyncio.run(AddressGuard(inner, SECRET)(scope, receive, send))
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

    client = SimpleNamespace(connected=connected, is_deleted=False)
    context = SimpleNamespace(client=client)
    ignored: Any = lambda *_, **__: None  # noqa: E731
    monkeypatch.setattr(lab_page, "ui", SimpleNamespace(add_css=ignored, colors=ignored, context=context))
    monkeypatch.setattr(lab_page, "_Page", lambda _: SimpleNamespace(build=ignored, open=show))
    asyncio.run(lab_page.show_page(SimpleNamespace(draft="draft")))  # type: ignore[arg-type]
    assert opened == ([] if has_left else ["draft"])

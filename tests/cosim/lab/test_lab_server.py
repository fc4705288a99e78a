"""Whom the page's server answers, and with which address it opens the browser."""

import asyncio
import faulthandler
import os
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from cosim.lab import lab_server
from cosim.lab.lab_server import AddressGuard, LabOptions

SECRET, OPENING = "s" * 43, "o" * 43


def answer(kind: str, path: str, **headers: str) -> list[MutableMapping[str, Any]]:
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
    scope = {
        "type": kind, "path": path, "headers": encoded_headers, "query_string": b"a=1",
        "client": ("127.0.0.1", 4711), "server": ("127.0.0.1", 8765),
    }  # fmt: skip
    asyncio.run(AddressGuard(inner, SECRET, OPENING)(scope, receive, send))
    return sent


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
    ],
)
def test_only_the_page_itself_is_answered(
    kind: str, path: str, headers: dict[str, str], status: int | None
) -> None:
    first, *_ = answer(kind, path, **headers)
    assert first.get("status") == status
    assert (first["type"] == "websocket.close") == (status is None)
    if status == 200:
        names = {name for name, _ in first["headers"]}
        assert {b"content-security-policy", b"x-frame-options", b"referrer-policy"} <= names


@pytest.mark.parametrize("user", [os.getuid(), os.getuid() + 1, None])
def test_the_address_on_a_command_line_is_for_processes_of_this_user(
    user: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every user can read command lines."""
    connections = []
    monkeypatch.setattr(lab_server, "socket_user", lambda *of: connections.append(of) or user)
    first, _ = answer("http", f"/{OPENING}/", host="127.0.0.1:8765")
    assert connections == [(("127.0.0.1", 4711), ("127.0.0.1", 8765))]
    if user == os.getuid():
        assert first["status"] == 303
        assert dict(first["headers"])[b"location"] == f"/{SECRET}/?a=1".encode()
    else:
        assert first["status"] == 404
        assert SECRET not in str(first)


def test_the_browser_is_started_with_the_address_for_command_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened_urls, announced_urls = list[str](), list[str]()

    def open_page(address: str) -> None:
        opened_urls.append(address)
        raise KeyboardInterrupt

    monkeypatch.setattr(lab_server.webbrowser, "open", open_page)
    options = LabOptions("lane_following", "", tmp_path, tmp_path / "runs", 0, open_browser=True)
    lab_server.serve(options, announced_urls.append)
    faulthandler.cancel_dump_traceback_later()
    (page,), (line) = announced_urls, opened_urls[0]
    assert urlsplit(page).netloc == urlsplit(line).netloc
    assert urlsplit(page).path != urlsplit(line).path

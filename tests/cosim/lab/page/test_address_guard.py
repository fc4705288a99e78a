"""Only requests that know the secret and come from the page itself are answered."""

import asyncio
from collections.abc import MutableMapping
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="the extra `lab` is not installed")

from cosim.lab.page.address_guard import AddressGuard

SECRET = "s" * 43


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

    given = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": kind, "path": path, "headers": given}
    asyncio.run(AddressGuard(inner, SECRET)(scope, receive, send))
    return sent


def test_the_page_is_answered_with_headers_that_protect_it() -> None:
    (message,) = answer("http", f"/{SECRET}/", host="127.0.0.1:8765")
    assert message["status"] == 200
    names = {name for name, _ in message["headers"]}
    assert {b"content-security-policy", b"x-frame-options", b"referrer-policy"} <= names


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/", {"host": "127.0.0.1:8765"}, 404),
        (f"/{SECRET[:-1]}/", {"host": "127.0.0.1:8765"}, 404),
        (f"/{SECRET}x/", {"host": "127.0.0.1:8765"}, 404),
        (f"/{SECRET}/", {}, 403),
        (f"/{SECRET}/", {"host": "evil.example:8765"}, 403),
        (f"/{SECRET}/", {"host": "127.0.0.1.evil.example"}, 403),
        (f"/{SECRET}/", {"host": "127.0.0.1:8765", "origin": "http://evil.example"}, 403),
        (f"/{SECRET}/", {"host": "127.0.0.1:8765", "origin": "http://127.0.0.1:9999"}, 403),
        (f"/{SECRET}/", {"host": "127.0.0.1:8765", "origin": "null"}, 403),
    ],
)
def test_others_are_refused(path: str, headers: dict[str, str], status: int) -> None:
    first, _ = answer("http", path, **headers)
    assert first["status"] == status


@pytest.mark.parametrize("origin", [None, "http://evil.example"])
def test_a_websocket_of_another_page_is_refused(origin: str | None) -> None:
    headers = {"host": "127.0.0.1:8765"} | ({} if origin is None else {"origin": origin})
    (message,) = answer("websocket", f"/{SECRET}/", **headers)
    assert message["type"] == "websocket.close"

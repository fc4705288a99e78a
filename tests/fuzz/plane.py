"""A control plane without zenoh; the test supplies the messages."""

import json
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from noack.runtime.connections.zenoh_session import label
from noack.runtime.control_messages import message_json


class Payload:
    """Bytes with zenoh's interface."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def to_bytes(self) -> bytes:
        return self._data

    def to_string(self) -> str:
        return self._data.decode()  # zenoh raises the same error


class Sample:
    """A publication; ``sent_as`` is the key with which it was sent."""

    def __init__(self, key: str, payload: bytes | None = b"", header: bytes | None = b"", sent_as: str = ""):
        self.key_expr = key
        self.payload = Payload(payload or b"")
        self.attachment = None if header is None else Payload(label(sent_as or key, header))
        self.kind = None


@dataclass
class Query:
    """A request and its replies."""

    key_expr: str
    data: bytes | None
    replies: list[str] = field(default_factory=list)
    error: str | None = None
    answered: int = 0
    dismissed: bool = False
    """Whether the request was dropped without a reply, so that the process sends it again."""

    @property
    def payload(self) -> Payload | None:
        return None if self.data is None else Payload(self.data)

    def reply(self, key: object, content: str) -> None:
        self.answered += 1
        self.replies.append(content)

    def reply_err(self, message: str) -> None:
        self.answered += 1
        self.error = message

    def drop(self) -> None:
        pass


class _Channel(deque[Any]):
    def try_recv(self) -> Any:
        return self.popleft() if self else None


class FakePlane:
    """The part of the control plane and its session that recorder and coordinator use."""

    def __init__(self) -> None:
        self.is_closed = False
        self.session = self
        self.instance = "fake"
        self.answers: list[Any] = []
        self.announced: list[Any] = []
        self.acknowledged: dict[str, Any] = {}
        """The newest acknowledgement to each process."""
        self._channels: dict[str, _Channel] = {}

    def __enter__(self) -> "FakePlane":
        return self

    def __exit__(self, *_: object) -> None:
        self.is_closed = True

    def key(self, *parts: str) -> str:
        return "/".join(parts)

    def declare_subscriber(self, key: str, handler: object = None, *, history: bool = False) -> _Channel:
        return self._channels.setdefault(key.partition("/")[0], _Channel())

    declare_queryable = declare_subscriber

    def liveliness(self) -> "FakePlane":
        return self

    def put(self, key: str, content: Any) -> None:
        self._channels[key].append(content)

    def publish(self, *parts: str, content: Any) -> None:
        pass

    def answer(self, query: Query, content: Any) -> None:
        self.answers.append(content)
        query.reply(query.key_expr, message_json(content).decode())

    def refuse(self, query: Query, reason: str) -> None:
        query.reply_err(reason)

    def dismiss(self, query: Query) -> None:
        query.dismissed = True

    def announce_change(self, content: Any) -> None:
        self.announced.append(json.loads(message_json(content)))

    def acknowledge_rows(self, role: str, content: Any) -> None:
        self.acknowledged[role] = json.loads(message_json(content))

    def request_stop(self, reason: str) -> None:
        pass

    def coordinator_gone(self) -> bool:
        return False

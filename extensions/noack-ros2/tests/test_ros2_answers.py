"""Which answers of nodes count: whole ones, of the sender of the first."""

from contextlib import suppress
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from noack_ros2 import ros2_messages as ros2
from noack_ros2.ros2_node import _ATTACHMENT, Node, TopicExchange

NODE, OTHER = b"n" * 16, b"o" * 16


def message(content: bytes, sender: bytes | None) -> Any:
    attachment = None if sender is None else _ATTACHMENT.pack(1, 2, 16) + sender
    return SimpleNamespace(
        payload=SimpleNamespace(to_bytes=lambda: content),
        attachment=None if attachment is None else SimpleNamespace(to_bytes=lambda: attachment),
    )


def state(stamp_ns: int, *values: float) -> bytes:
    return ros2.joint_state(ros2.Entries(stamp_ns, ("x",) * len(values), np.array(values)), "lane")


class Graph:
    """A node whose topic of answers has these messages."""

    def __init__(self, *messages: Any) -> None:
        self.messages = list(messages)

    def subscription(self, _topic: str) -> Any:
        return SimpleNamespace(try_recv=lambda: self.messages.pop(0) if self.messages else None)

    def publisher(self, _topic: str) -> Any:
        return SimpleNamespace(publish=lambda *_, **__: None)


def exchange(*messages: Any) -> TopicExchange:
    return TopicExchange(cast(Node, Graph(*messages)), "/ask", "/answer", "lane")


def question(stamp_ns: int) -> ros2.Entries:
    return ros2.Entries(stamp_ns, ("u",), np.zeros(1))


def test_another_sender_does_not_supply_the_state(capsys: pytest.CaptureFixture[str]) -> None:
    asked = exchange(
        message(state(0, 1.0), NODE),
        message(state(5, 666.0), OTHER), message(state(5, 667.0), None), message(state(5, 2.0), NODE),
    )  # fmt: skip
    assert asked.ask(question(0), 1, 10.0).values.tolist() == [1.0]
    assert asked.ask(question(5), 1, 10.0).values.tolist() == [2.0]
    assert asked.skipped == {"of another sender than the first answer": 2}
    assert capsys.readouterr().err.count("of another sender") == 1


def test_a_malformed_message_is_skipped_and_counted() -> None:
    whole = state(5, 2.0)
    huge = whole[:16] + b"\xff" * 8 + whole[24:]
    damaged = [b"", b"\0", whole[:20], huge, bytes(range(256)) * 4, state(5, 1.0, 2.0), state(5)]
    for sender in (NODE, OTHER, None):
        asked = exchange(*[message(content, sender) for content in damaged], message(whole, NODE))
        assert asked.ask(question(5), 1, 10.0).values.tolist() == [2.0]
        assert asked.skipped.total() == len(damaged)
        assert len(asked.skipped) <= 5


def test_damaged_bytes_are_no_message_whatever_they_are() -> None:
    rng = np.random.default_rng(1)
    whole = np.frombuffer(state(5, 2.0, 3.0), np.uint8)
    for _ in range(2000):
        damaged = whole.copy()
        damaged[rng.integers(len(whole), size=3)] = rng.integers(256, size=3)
        with suppress(ValueError):  # nothing else
            ros2.read_joint_state(damaged.tobytes())


def test_without_a_valid_answer_the_causes_are_said() -> None:
    asked = exchange(message(state(5, 1.0, 2.0), NODE))
    expected = (
        r"^no answer on /answer to /ask within 0.05 s; skipped 1 messages: 2 values in `position`; 1 needed$"
    )
    with pytest.raises(TimeoutError, match=expected):
        asked.ask(question(5), 1, 0.05)

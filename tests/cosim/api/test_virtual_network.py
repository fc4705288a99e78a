"""``noack.VirtualNetwork`` refuses wrong arguments, which no command has, by a line."""

import re
from collections.abc import Callable
from typing import Any

import pytest

import noack


def network(**options: Any) -> Any:
    return noack.VirtualNetwork({"mansd": 1, "loss": {"model": "lossless"}}, **options)


@pytest.mark.parametrize(("call", "line"), [
    (lambda: network(seed=-1), "seed -1: expected at least 0"),
    (lambda: network(seed="x"), "seed x: expected a whole number"),
    (lambda: network(seed=True), "seed True: expected a whole number"),
    (lambda: network(episode=-1), "episode -1: expected at least 0"),
    (lambda: network().send("up", 0, 1, 0), "direction up: 'up' is not one of 'update'"),
    (lambda: network().consecutive_losses("up"), "direction up: 'up' is not one of 'update'"),
    (lambda: network().send("update", 0, -1, 0), "entries -1: expected at least 0"),
    (lambda: network().send("update", 0, 1, 0.5), "now_ns 0.5: expected a whole number"),
    (lambda: network().receive(-1), "now_ns -1: expected at least 0"),
])  # fmt: skip
def test_a_wrong_argument_is_refused(call: Callable[[], object], line: str) -> None:
    with pytest.raises(noack.NoackError, match=f"^{re.escape(line)}$"):
        call()


def test_time_does_not_go_back() -> None:
    lossless = network()
    lossless.send("update", 0, 1, 1000)
    with pytest.raises(noack.NoackError, match="now_ns 999: expected at least 1000"):
        lossless.send("update", 1, 1, 999)
    assert [packet.content for packet in lossless.send("update", 1, 1, 1000)] == [1]

"""The start barrier on a busy machine: a process that only seemed to be gone comes back to it."""

import json
from typing import Any

import pytest
import zenoh

from cosim.live import coordinator
from cosim.live.coordinator import Coordinator
from noack.protocol.topology import ROLES
from tests.fuzz.parsers.ticket import _TICKET
from tests.fuzz.plane import FakePlane, Query, Sample


@pytest.fixture
def plane() -> FakePlane:
    return FakePlane()


@pytest.fixture
def barrier(plane: FakePlane, monkeypatch: pytest.MonkeyPatch) -> Coordinator:
    monkeypatch.setattr(coordinator, "Plane", lambda *_, **__: plane)
    monkeypatch.setattr(coordinator, "_LEAVE_GRACE_S", -1.0)  # a token that is gone, is gone
    return Coordinator(_TICKET)


def ask(plane: FakePlane, barrier: Coordinator, what: str, instance: str = "one") -> Query:
    hello: dict[str, Any] = {"pid": 1, "instance": instance, "address": ["127.0.0.1", 5]}
    plane.put(what, query := Query(f"noack/0/{what}/sensor", json.dumps(hello).encode()))
    barrier.poll()
    return query


def lose(plane: FakePlane, barrier: Coordinator) -> None:
    gone = Sample("noack/0/alive/sensor/one")
    gone.kind = zenoh.SampleKind.DELETE  # type: ignore[assignment]
    plane.put("alive", gone)
    barrier.poll()


def test_who_only_seemed_to_be_gone_may_join_again(plane: FakePlane, barrier: Coordinator) -> None:
    ask(plane, barrier, "admit")
    first = ask(plane, barrier, "join")
    assert "sensor" not in barrier.missing()
    lose(plane, barrier)
    assert "sensor" in barrier.missing()
    assert first.dismissed  # it asks again by itself
    assert not first.answered
    second = ask(plane, barrier, "join")
    assert second.error is None
    assert barrier.missing() == tuple(role for role in ROLES if role != "sensor")


def test_when_another_has_come_in_its_stead_it_may_not(
    plane: FakePlane, barrier: Coordinator
) -> None:
    ask(plane, barrier, "admit")
    ask(plane, barrier, "join")
    lose(plane, barrier)
    ask(plane, barrier, "admit", "two")
    assert ask(plane, barrier, "join", "two").error is None
    assert ask(plane, barrier, "join").error == (
        "cannot join: another sensor is in this run already"
    )


def test_why_a_process_ended_is_known_from_itself(plane: FakePlane, barrier: Coordinator) -> None:
    """Also of one that never joined."""
    assert barrier.last_words("sensor") is None
    plane.put("left", Sample("noack/0/left/sensor/one", b"the disk is full"))
    barrier.poll()
    assert barrier.last_words("sensor") == "the disk is full"
    plane.put("left", Sample("noack/0/left/netem/one", b"horizon"))
    barrier.poll()
    assert barrier.last_words("netem") is None

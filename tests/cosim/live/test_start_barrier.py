"""The start barrier: a process that loses its connection may join again."""

import json
from typing import Any

import pytest
import zenoh

from cosim.live import coordinator
from cosim.live.coordinator import AdmissionPass, Coordinator
from noack.protocol.topology import RECORDER, ROLES
from tests.fuzz.parsers.ticket import _TICKET
from tests.fuzz.plane import FakePlane, Query, Sample


@pytest.fixture
def plane() -> FakePlane:
    return FakePlane()


@pytest.fixture
def barrier(plane: FakePlane, monkeypatch: pytest.MonkeyPatch) -> Coordinator:
    monkeypatch.setattr(coordinator, "ControlPlane", lambda *_, **__: plane)
    monkeypatch.setattr(coordinator, "_REPORT_GRACE_S", -1.0)  # do not wait for reports
    return Coordinator(_TICKET)


def ask(
    plane: FakePlane,
    barrier: Coordinator,
    what: str,
    instance: str = "one",
    role: str = "sensor",
    shown: str = _TICKET.admission_pass,
) -> Query:
    address = None if role == RECORDER else ["127.0.0.1", 5]
    hello: dict[str, Any] = {"instance": instance, "address": address, "admission_pass": shown}
    plane.put(what, query := Query(f"noack/0/{what}/{role}", json.dumps(hello).encode()))
    barrier.poll()
    return query


def token(plane: FakePlane, barrier: Coordinator, kind: zenoh.SampleKind | None) -> None:
    change = Sample("noack/0/alive/sensor/one")
    change.kind = kind  # type: ignore[assignment]
    plane.put("alive", change)
    barrier.poll()


def lose(plane: FakePlane, barrier: Coordinator) -> None:
    token(plane, barrier, zenoh.SampleKind.DELETE)


def test_a_process_may_join_again_after_a_lost_connection(
    plane: FakePlane, barrier: Coordinator
) -> None:
    ask(plane, barrier, "admit")
    first = ask(plane, barrier, "join")
    assert "sensor" not in barrier.missing()
    lose(plane, barrier)
    assert "sensor" in barrier.missing()
    assert first.dismissed  # the process sends it again
    assert not first.answered
    second = ask(plane, barrier, "join")
    assert second.error is None
    assert barrier.missing() == tuple(role for role in ROLES if role != "sensor")


def test_a_process_may_not_join_again_once_another_has_its_role(
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


def test_the_reason_for_an_end_is_the_reported_one(plane: FakePlane, barrier: Coordinator) -> None:
    assert barrier.reported_failure("sensor") is None
    plane.put("ended", Sample("noack/0/ended/sensor/one", b"rows", sent_as="noack/0/progress"))
    barrier.poll()
    assert barrier.reported_failure("sensor") is None
    plane.put("ended", Sample("noack/0/ended/sensor/one", b"the disk is full"))
    barrier.poll()
    assert barrier.reported_failure("sensor") == "the disk is full"
    plane.put("ended", Sample("noack/0/ended/netem/one", b"horizon"))
    barrier.poll()
    assert barrier.reported_failure("netem") is None


def test_a_running_process_is_lost_only_if_its_connection_does_not_come_back(
    plane: FakePlane, barrier: Coordinator, monkeypatch: pytest.MonkeyPatch
) -> None:
    for role in ROLES:
        ask(plane, barrier, "admit", role=role)
        ask(plane, barrier, "join", role=role)
    assert barrier.epoch_ns is not None
    lose(plane, barrier)
    assert barrier.failures() == {}
    barrier.allow_restart("sensor", "stopped responding", dead=False)
    assert ask(plane, barrier, "admit", "two").error == (
        "cannot join: the sensor before it may still come back; try again in 8 s"
    )
    token(plane, barrier, None)
    monkeypatch.setattr(coordinator, "AWAY_S", -1.0)
    barrier.poll()
    assert barrier.failures() == {}
    lose(plane, barrier)
    assert barrier.failures() == {"sensor": "sensor stopped responding"}
    assert ask(plane, barrier, "admit", "two").error is None


@pytest.mark.parametrize(
    ("known", "shown", "role", "reason"),
    [
        (AdmissionPass(), "ab" * 16, "sensor", None),
        (AdmissionPass(), "", "sensor", "its ticket or invitation is not of this run"),
        (AdmissionPass(), "cd" * 16, "sensor", "its ticket or invitation is not of this run"),
        (AdmissionPass(["plant"]), "ab" * 16, "plant", None),
        (AdmissionPass(["plant"]), "ab" * 16, "sensor", "its invitation is for the plant only"),
        (AdmissionPass(until_s=-1.0), "ab" * 16, "sensor", "its invitation has expired"),
    ],
)
def test_a_pass_admits_its_roles_until_it_expires(
    plane: FakePlane, barrier: Coordinator, known: AdmissionPass, shown: str, role: str,
    reason: str | None,
) -> None:  # fmt: skip
    barrier.passes["ab" * 16] = known
    asked = ask(plane, barrier, "admit", role=role, shown=shown)
    assert asked.error == (None if reason is None else f"cannot join: {reason}")
    joined = ask(plane, barrier, "join", role=role)
    assert joined.error == (None if reason is None else "cannot join: it was not admitted")

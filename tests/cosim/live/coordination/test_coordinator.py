"""The coordinator: admission, lost connections."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import zenoh

from cosim.live.coordination import coordinator
from cosim.live.coordination.coordinator import Coordinator
from noack.protocol.roles import LOOP_ROLES, RECORDER, ROLES
from noack.runtime.control_messages import ClockError
from noack.runtime.host_clocks import CHRONY
from noack.runtime.telemetry import OwnSpool
from noack.scenario.resolution import ResolvedRun
from noack.scenario.run_sections import ClocksSection
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.helpers.run_descriptors import JUNK, RUN_DESCRIPTOR


@pytest.fixture
def plane() -> FakePlane:
    return FakePlane()


@pytest.fixture
def barrier(plane: FakePlane, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Coordinator:
    monkeypatch.setattr(coordinator, "ControlPlane", lambda *_, **__: plane)
    monkeypatch.setattr(coordinator, "_REPORT_GRACE_S", -1.0)  # do not wait for reports
    access = RUN_DESCRIPTOR.model_copy(update={"run_dir": str(tmp_path)})
    return Coordinator(access, ResolvedRun(RUN_DESCRIPTOR.scenario))


def ask(
    plane: FakePlane,
    barrier: Coordinator,
    what: str,
    instance: str = "one",
    role: str = "sensor",
    **more: object,
) -> Query:
    address = None if role == RECORDER else ["127.0.0.1", 5 + ROLES.index(role)]
    request: dict[str, Any] = {"instance": instance, "address": address, **more}
    plane.put(what, query := Query(f"noack/0/{what}/{role}", json.dumps(request).encode()))
    barrier.poll()
    return query


def token(plane: FakePlane, barrier: Coordinator, kind: zenoh.SampleKind | None) -> None:
    change = Sample("noack/0/alive/sensor/one")
    change.kind = kind  # type: ignore[assignment]
    plane.put("alive", change)
    barrier.poll()


def lose(plane: FakePlane, barrier: Coordinator) -> None:
    token(plane, barrier, zenoh.SampleKind.DELETE)


def end(plane: FakePlane, barrier: Coordinator, reason: bytes) -> None:
    plane.put("ended", Sample("noack/0/ended/sensor/one", reason, sent_as=""))
    barrier.poll()


def test_an_invalid_request_is_refused_and_the_others_join(plane: FakePlane, barrier: Coordinator) -> None:
    for junk in JUNK:
        plane.put("progress", Sample("progress", junk))
        assert barrier.progress() is None
        for question in ("admit", "join"):
            plane.put(question, bad := Query(f"noack/0/{question}/plant", junk))
            barrier.poll()
            assert bad.error is not None
            assert bad.error.startswith("cannot join: ")
    for role in ROLES:
        for question in ("admit", "join"):
            assert ask(plane, barrier, question, role=role).error is None
    assert barrier.epoch_ns is not None
    assert plane.answers[-1].addresses.keys() == set(LOOP_ROLES)


def test_a_process_may_join_again_after_a_lost_connection_unless_another_has_its_role(
    plane: FakePlane, barrier: Coordinator
) -> None:
    ask(plane, barrier, "admit")
    first = ask(plane, barrier, "join")
    assert "sensor" not in barrier.missing()
    lose(plane, barrier)
    assert "sensor" in barrier.missing()
    assert first.dismissed  # the process sends it again
    assert not first.answered
    assert ask(plane, barrier, "join").error is None
    assert barrier.missing() == tuple(role for role in ROLES if role != "sensor")
    lose(plane, barrier)
    ask(plane, barrier, "admit", "two")
    assert ask(plane, barrier, "join", "two").error is None
    assert ask(plane, barrier, "join").error == ("cannot join: another sensor is in this run already")


def test_the_reason_for_an_end_is_the_reported_one(plane: FakePlane, barrier: Coordinator) -> None:
    for role, text, sent_as, reason in (
        ("sensor", b"rows", "noack/0/progress", None),
        ("sensor", b"the disk is full", "", "the disk is full"),
        ("netem", b"horizon", "", None),
    ):
        plane.put("ended", Sample(f"noack/0/ended/{role}/one", text, sent_as=sent_as))
        barrier.poll()
        assert barrier.await_reported_failure(role) == reason


def test_a_running_process_is_lost_only_if_its_connection_does_not_come_back(
    plane: FakePlane, barrier: Coordinator, monkeypatch: pytest.MonkeyPatch
) -> None:
    for role in ROLES:
        ask(plane, barrier, "admit", role=role)
        ask(plane, barrier, "join", role=role)
    assert barrier.epoch_ns is not None
    lose(plane, barrier)
    assert barrier.failures() == {}
    assert ask(plane, barrier, "admit", "two").error == "cannot join: another sensor is in this run already"
    token(plane, barrier, None)
    monkeypatch.setattr(barrier._members["sensor"], "lost_after_s", -1.0)
    barrier.poll()
    assert barrier.failures() == {}
    lose(plane, barrier)
    assert barrier.failures() == {"sensor": "sensor stopped responding"}
    assert barrier.is_over("sensor")
    assert not barrier.has_ended("sensor")
    assert ask(plane, barrier, "join").answered  # it is back
    assert barrier.failures() == {}
    end(plane, barrier, b"the disk is full")
    lose(plane, barrier)
    assert barrier.failures() == {"sensor": "sensor ended early: the disk is full"}
    assert barrier.has_ended("sensor")
    assert ask(plane, barrier, "join").error == "cannot join: it has ended"


def test_a_process_that_ends_before_the_start_leaves_its_place(
    plane: FakePlane, barrier: Coordinator
) -> None:
    ask(plane, barrier, "admit")
    waiting = ask(plane, barrier, "join")
    end(plane, barrier, b"no memory")
    assert waiting.dismissed
    assert "sensor" in barrier.missing()
    assert barrier.failures() == {}
    ask(plane, barrier, "admit", "two")
    assert ask(plane, barrier, "join", "two").error is None


@pytest.mark.parametrize(("error_us", "refused"), [(999, False), (1000, False), (1001, True)])
def test_a_host_whose_clock_may_be_off_by_too_much_is_refused(
    plane: FakePlane, monkeypatch: pytest.MonkeyPatch, error_us: int, refused: bool
) -> None:
    monkeypatch.setattr(coordinator, "ControlPlane", lambda *_, **__: plane)
    scenario = RUN_DESCRIPTOR.scenario.model_copy(update={"clocks": ClocksSection()})
    own = ClockError(clock="one", error_ns=7000, source=CHRONY)
    barrier = Coordinator(RUN_DESCRIPTOR, ResolvedRun(scenario), own_clock=own)
    other = ClockError(clock="two", error_ns=error_us * 1000, source=CHRONY)
    answer = ask(plane, barrier, "admit", role="sensor", clock=other.fields())
    if refused:
        assert answer.error == (
            "cannot join: the clock of the sensor's host may be off by 1001 µs, as `chronyc tracking` says; "
            "clocks.largest_error_us = 1000 allows less"
        )
        return
    assert answer.error is None
    assert barrier.notices == [
        "the clock of this host may be off by at most 7 µs",
        f"the clock of the sensor's host may be off by at most {error_us} µs",
    ]
    for role in ROLES:
        if role != "sensor":
            ask(plane, barrier, "admit", role=role)
        ask(plane, barrier, "join", role=role)
    assert plane.answers[-1].clocks == {role: other if role == "sensor" else own for role in LOOP_ROLES}


def start(plane: FakePlane, barrier: Coordinator) -> None:
    for role in ROLES:
        ask(plane, barrier, "admit", role=role)
        ask(plane, barrier, "join", role=role)
    assert barrier.epoch_ns is not None


@pytest.mark.parametrize(("ended", "failures"), [
    ("horizon", {}), ("the disk is full", {"sensor": "sensor ended early: the disk is full"}),
])  # fmt: skip
def test_a_process_that_could_not_report_its_end_is_not_lost(
    plane: FakePlane, barrier: Coordinator, tmp_path: Path, ended: str, failures: dict[str, str]
) -> None:
    """It could not, as this process was stopped at the horizon: its report is on disk."""
    start(plane, barrier)
    report = {"ended": ended, "channel": {}, "rows": {}}
    spool = OwnSpool(tmp_path, "sensor", "secret")
    spool.keep_report(report | {"instance": "another"})
    lose(plane, barrier)
    assert not barrier.has_ended("sensor")
    spool.keep_report(report | {"instance": "one"})
    spool.files.close()
    barrier._members["sensor"].lost_after_s = -1.0
    barrier._next_look_s = -math.inf
    barrier.poll()
    assert barrier.has_ended("sensor")
    assert barrier.is_over("sensor")
    assert barrier.failures() == failures


def test_while_the_coordinator_was_stopped_no_process_is_lost(plane: FakePlane, barrier: Coordinator) -> None:
    """No connection could come back."""
    start(plane, barrier)
    lose(plane, barrier)
    member, stopped_s = barrier._members["sensor"], 20.0
    assert member.vanished_s is not None
    member.vanished_s -= stopped_s
    barrier._polled_s -= stopped_s
    barrier.poll()
    assert barrier.failures() == {}
    member.vanished_s -= stopped_s
    barrier.poll()
    assert barrier.failures() == {"sensor": "sensor stopped responding"}

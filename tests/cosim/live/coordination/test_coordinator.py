"""The coordinator: admission, lost connections, changes of a run."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from cosim.live.coordination import coordinator
from cosim.live.coordination.coordinator import ChangeRequests, Coordinator
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.protocol.roles import LOOP_ROLES, RECORDER, ROLES
from noack.runtime.control_messages import ClockError
from noack.runtime.host_clocks import CHRONY
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario_file import load
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.helpers.run_descriptors import JUNK, RUN_DESCRIPTOR

SHARED = Path(__file__).parents[4] / "scenarios" / "shared_bottleneck.toml"


@pytest.fixture
def plane() -> FakePlane:
    return FakePlane()


@pytest.fixture
def barrier(plane: FakePlane, monkeypatch: pytest.MonkeyPatch) -> Coordinator:
    monkeypatch.setattr(coordinator, "ControlPlane", lambda *_, **__: plane)
    monkeypatch.setattr(coordinator, "_REPORT_GRACE_S", -1.0)  # do not wait for reports
    return Coordinator(RUN_DESCRIPTOR)


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
    monkeypatch.setattr(coordinator, "LOST_AFTER_S", -1.0)
    barrier.poll()
    assert barrier.failures() == {}
    lose(plane, barrier)
    assert barrier.failures() == {"sensor": "sensor stopped responding"}


@pytest.mark.parametrize(("error_us", "refused"), [(999, False), (1000, False), (1001, True)])
def test_a_host_whose_clock_may_be_off_by_too_much_is_refused(
    plane: FakePlane, monkeypatch: pytest.MonkeyPatch, error_us: int, refused: bool
) -> None:
    monkeypatch.setattr(coordinator, "ControlPlane", lambda *_, **__: plane)
    scenario = RUN_DESCRIPTOR.scenario.model_copy(update={"clocks": ClocksSection()})
    own = ClockError(clock="one", error_ns=7000, source=CHRONY)
    descriptor = RUN_DESCRIPTOR.model_copy(update={"scenario": scenario})
    barrier = Coordinator(descriptor, own_clock=own)
    other = ClockError(clock="two", error_ns=error_us * 1000, source=CHRONY)
    answer = ask(plane, barrier, "admit", role="sensor", clock=other.fields())
    if refused:
        assert answer.error == (
            "cannot join: the clock of the sensor's host may be off by 1001 µs by chronyc tracking, "
            "clocks.largest_error_us = 1000 allowed"
        )
        return
    assert answer.error is None
    assert barrier.notices == [f"the clock of the sensor's host may be off by at most {error_us} µs"]
    for role in ROLES:
        if role != "sensor":
            ask(plane, barrier, "admit", role=role)
        ask(plane, barrier, "join", role=role)
    assert plane.answers[-1].clocks == {role: other if role == "sensor" else own for role in LOOP_ROLES}


# --- requests to change a run ---------------------------------------------------------------------


def requests_of(loops: str, *settings: str) -> ChangeRequests:
    descriptor = SimpleNamespace(scenario=load(SHARED, [f"loops=[{loops}]", *settings]), run_dir="here")
    plane = SimpleNamespace(announce_change=lambda announcement: None)
    return ChangeRequests(cast("Any", descriptor), cast("Any", plane))


def requested(requests: ChangeRequests, settings: dict[str, Any], now_s: float = 0.0) -> dict[str, Any]:
    request = json.dumps({"settings": settings}).encode()
    return requests.answer(request, lambda: round(now_s * NS_PER_S), None).fields()


@pytest.mark.parametrize("loops", [1, 4])
def test_every_listed_parameter_can_be_changed(loops: int) -> None:
    entry = f'{{ name = "p", count = {loops} }}'
    listed = requested(requests_of(entry), {})["runtime_parameters"]
    assert {"trigger.beta", "network.mansd", "controller.setpoint"} <= listed.keys()
    for key, value in listed.items():
        assert requested(requests_of(entry), {key: value})["from_s"] is None  # it is in force already
    with pytest.raises(CallerError, match=r"plant\.rate_hz"):
        requested(requests_of(entry), {"plant.rate_hz": 100.0})


def test_a_value_that_is_in_force_is_no_change_unless_another_one_is_to_come() -> None:
    requests = requests_of('{ name = "p" }')  # with M − 1 = 3
    from_s = [
        requested(requests, {"network.mansd": mansd}, now_s)["from_s"]
        for mansd, now_s in ((3, 0.0), (2, 0.0), (2, 0.1), (2, 1.0), (3, 1.0))
    ]
    assert from_s == [None, 0.2, 0.3, None, 1.2]
    assert len(requests.announced) == 3


def test_a_change_warns_of_the_assumptions_that_it_violates() -> None:
    requests = requests_of('{ name = "p" }')
    (warning,) = requested(requests, {"trigger.alpha_per_s": 5.0})["warnings"]
    assert warning.startswith("violated: 0 < α < ᾱ: the threshold decays more slowly than the closed loop")
    assert not requested(requests, {"network.mansd": 2})["warnings"]


def test_a_refused_change_has_no_effect_on_the_next_one() -> None:
    """It is valid now and with the last settings, but not with the first of those scheduled."""
    change = 'changes=[{ at_s = 8.0, set = { "network.mansd" = 2 } }]'
    requests = requests_of('{ name = "p", count = 2 }', change)
    impossible_loss = {"model": "bernoulli", "probability": 0.8, "keep": True}
    with pytest.raises(CallerError, match=r"network\.loss: loss 80% keep: impossible"):
        requested(requests, {"network.mansd": 10, "network.loss": impossible_loss})
    loss = impossible_loss | {"probability": 0.2}
    assert requested(requests, {"network.loss": loss})["from_s"] > 0
    parameters = requested(requests, {})["runtime_parameters"]
    assert (parameters["network.mansd"], parameters["network.loss"]["probability"]) == (2, 0.2)
    assert [announcement.number for announcement in requests.announced] == [0, 1]


def test_a_change_beyond_the_last_one_or_the_end_of_the_run_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    requests, settings = requests_of('{ name = "p" }'), {"network.mansd": 2}
    monkeypatch.setattr(coordinator, "MOST_CHANGES", 2)
    for _ in range(2):
        requested(requests, settings)
    with pytest.raises(CallerError, match="this run has had 2 changes, the maximum"):
        requested(requests, settings)
    assert len(requests.announced) == 2
    with pytest.raises(CallerError, match=r"the run ends at 0\.1 s, before a change could apply"):
        requested(requests_of('{ name = "p" }', "horizon_s=0.1"), settings)

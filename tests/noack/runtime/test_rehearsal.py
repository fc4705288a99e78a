"""Rehearsals run the rare path of a process on copies, and touch nothing else."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from controller_node.controller import controller_of
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import validate
from noack.protocol.machine_interface import Machine, Output
from noack.protocol.topology import RECEIVES, SENDS
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message
from noack.runtime import rehearsal
from noack.runtime.rehearsal import Rehearsal, can_rehearse
from noack.runtime.udp_sockets import MessageSocket, bind
from sensor_node.sensor import sensor_of

KEY = bytes(32)
MACHINES = {"sensor": sensor_of, "controller": controller_of}


class Watched:
    """A machine that keeps its outputs."""

    def __init__(self, machine: Machine[Message]) -> None:
        self._machine = machine
        self.outputs: list[Output] = []

    def handle(self, message: Message, now_ns: int) -> list[Output]:
        outputs = list(self._machine.handle(message, now_ns))
        self.outputs += outputs
        return outputs


@pytest.fixture
def scenario(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, ""))


@contextmanager
def rehearsal_of(role: str, scenario: Scenario) -> Iterator[tuple[Rehearsal, Watched]]:
    flow, machine = RECEIVES[role], Watched(MACHINES[role](scenario))
    entries = scenario.message_sizes.entries(flow)
    with closing(bind(0, "test")) as endpoint:
        own = endpoint.getsockname()
        channel = MessageSocket(
            endpoint, Decoder(flow, entries, 1, KEY), Encoder(1, KEY), SENDS[role],
            source=own, destination=own,
        )  # fmt: skip
        rehearsing = Rehearsal(machine, channel, Encoder(1, KEY), flow, entries)  # type: ignore[arg-type]
        with closing(rehearsing):
            yield rehearsing, machine


@pytest.mark.parametrize("role", MACHINES)
def test_each_rehearsal_passes_the_machine(
    role: str, scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rehearsal, "PERIOD_S", 0.0)
    with rehearsal_of(role, scenario) as (rehearse, machine):
        for _ in range(20):
            rehearse.rehearse()
        report = rehearse.report()
    assert report["rehearsals"] == 20
    assert 0 < report["cpu_share"] <= 1
    answers = [one for one in machine.outputs if isinstance(one, Message)]
    assert len(machine.outputs) - len(answers) == 20  # a row each, which nobody records
    if role == "sensor":
        assert [one.flow for one in answers] == [Flow.UPDATE] * 20, "each measurement is an event"


def test_a_rehearsal_follows_another_after_a_while(scenario: Scenario) -> None:
    with rehearsal_of("sensor", scenario) as (rehearse, _):
        rehearse.rehearse()
        rehearse._next_s += 3600.0
        rehearse.rehearse()
        assert rehearse.report()["rehearsals"] == 1


def test_a_rehearsal_can_be_postponed(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rehearsal, "POSTPONED_S", 3600.0)
    with rehearsal_of("sensor", scenario) as (rehearse, _):
        rehearse.postpone()
        rehearse.rehearse()
        assert rehearse.report()["rehearsals"] == 0


def test_an_error_ends_the_rehearsals_and_nothing_else(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rehearsal, "PERIOD_S", 0.0)
    calls = list[Message]()

    def fail(message: Message, now_ns: int) -> list[Output]:
        calls.append(message)
        raise OverflowError

    with rehearsal_of("sensor", scenario) as (rehearse, machine):
        monkeypatch.setattr(machine, "handle", fail)
        for _ in range(3):
            rehearse.rehearse()
            rehearse.postpone()
        assert rehearse.report()["rehearsals"] == 0
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("role", "changed", "expected"),
    [
        ("sensor", {}, True),
        ("controller", {}, True),
        ("plant", {}, False),
        ("netem", {}, False),
        ("sensor", {"realtime": {"rehearse": False}}, False),
        (
            "sensor",
            {"network": {"mansd": 2, "protocol": "ack", "loss": {"model": "lossless"}}},
            False,
        ),
    ],
)
def test_who_rehearses(
    content: dict[str, Any], role: str, changed: dict[str, Any], expected: bool
) -> None:
    assert can_rehearse(role, resolve(validate(content | changed, ""))) is expected

"""A link that must overflow is refused; certificates need a stated delay where a queue is."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import noack
from cosim.analysis.scenario_certificates import quick_certificate
from netem.core.errors import CallerError
from noack.protocol.wire_format import datagram_bytes
from noack.scenario.overload import refuse_overload
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.helpers.shipped import shipped

PERIODIC = {"policy": "periodic", "period_s": 0.05}
BITS = 8 * (datagram_bytes(2) + 28)
DEADLINE = {"policy": "deadline", "interval_s": 0.049,
            "rule": {"policy": "decaying", "beta": 0.5, "alpha_per_s": 0.25}}  # fmt: skip


def scenario_of(
    content: dict[str, Any], rate_bps: int, queue: int, *loops: dict[str, Any], **network: Any
) -> Scenario:
    rate = {"kind": "rate", "rate_bps": rate_bps, "queue": queue}
    content["network"] |= {"impairments": [rate], **network}
    return validate(content | {"loops": list(loops)}, "here")


@pytest.mark.parametrize(
    ("trigger", "constraints", "share"),
    [
        (PERIODIC, [], 1 / 3),
        (DEADLINE, [], 1 / 3),
        ({"policy": "dwell", "interval_s": 0.02, "rule": PERIODIC}, [], 1 / 3),
        # What is due happens in spite of a dwell time.
        ({**DEADLINE, "rule": {"policy": "dwell", "interval_s": 0.3, "rule": DEADLINE["rule"]}}, [], 1 / 3),
        (PERIODIC, [{"kind": "at_most", "losses": 1, "window": 10}], 9 / 10),
        (PERIODIC, [{"kind": "recovery", "deliveries": 3}], 3 / 5),
    ],
)
def test_the_rate_for_what_must_pass_is_the_limit(
    content: dict[str, Any], trigger: dict[str, Any], constraints: list[Any], share: float
) -> None:
    """At 100 Hz, a deadline of 49 ms means an event every 50 ms at the latest."""
    content["plant"]["rate_hz"] = 100.0
    loops = {"name": "a", "count": 30, "trigger": trigger}
    needed_bps = round(30 * BITS / 0.05 * share)
    refuse_overload(scenario_of(content, needed_bps, 5, loops, constraints=constraints))
    with pytest.raises(ValueError, match=re.escape(f"need {needed_bps} bit/s")):
        refuse_overload(scenario_of(content, needed_bps - 1, 5, loops, constraints=constraints))
    # Without the guarantee nothing must pass.
    refuse_overload(scenario_of(content, 1000, 5, loops, enforce_mansd=False))


def test_a_change_must_not_overload_the_link(content: dict[str, Any]) -> None:
    """M falls from 3 to 1: then each datagram must pass."""
    needed_bps = round(BITS / 0.05 / 3)
    loops, changes = {"name": "a", "trigger": PERIODIC}, [{"at_s": 0.5, "set": {"network.mansd": 0}}]
    refuse_overload(scenario_of(content, needed_bps, 5, loops))
    with pytest.raises(ValueError, match="1 of any 1 of each loop"):
        refuse_overload(scenario_of(content | {"changes": changes}, needed_bps, 5, loops))


def test_actuations_are_sent_at_each_tick(content: dict[str, Any]) -> None:
    loops, period_s = {"name": "a"}, 1 / validate(content, "here").controller.rate_hz
    needed_bps = round(8 * (datagram_bytes(1) + 28) / period_s / 2)
    rate = {"kind": "rate", "rate_bps": needed_bps - 1}
    actuation = {"mansd": 1, "impairments": [rate]}
    with pytest.raises(ValueError, match=re.escape("network.actuation.impairments.0: the datagrams")):
        refuse_overload(scenario_of(content, 10**9, 5, loops, actuation=actuation))


def test_recorded_opportunities_are_a_bottleneck(content: dict[str, Any]) -> None:
    """An opportunity carries 1504 bytes; a datagram has 32 more than its payload."""
    loops = {"name": "a", "count": 30, "trigger": PERIODIC}
    needed_bps = 30 * 8 * (datagram_bytes(2) + 32) / 0.05 / 3
    most_ms = int(1000 * 8 * 1504 / needed_bps)
    enough, less = (
        scenario_of(content, 1, 1, loops, impairments=[{"kind": "opportunities", "times_ms": [ms]}])
        for ms in (most_ms, most_ms + 1)
    )
    refuse_overload(enough)
    with pytest.raises(ValueError, match=f"need {int(needed_bps)} bit/s"):
        refuse_overload(less)


@pytest.mark.parametrize(
    ("order", "says"),
    [
        ([0, 1, 0], "order: loop 2 has no slot; the run has the loops 0 to 2"),
        ([0, 0, 0, 1, 2], "the datagrams that must pass, 1 of any 3 of loop 1 (a-2), need 1.033 slots"),
    ],
)
def test_a_schedule_has_enough_slots_for_each_loop(
    content: dict[str, Any], order: list[int], says: str
) -> None:
    """Loop 1 needs a slot in 3 × 50 ms; of five of these, it has one."""
    loops = {"name": "a", "count": 3, "trigger": PERIODIC}

    def given(slot_s: float) -> Scenario:
        schedule = {"kind": "schedule", "order": order, "slot_s": slot_s}
        return scenario_of(content, 1, 1, loops, impairments=[schedule])

    with pytest.raises(ValueError, match=re.escape(says)):
        refuse_overload(given(0.031))
    if len(order) == 5:
        refuse_overload(given(0.03))


OVERLOAD = {
    "trigger": PERIODIC,
    "network.impairments": [{"kind": "rate", "rate_bps": 1000, "queue": 5}],
}


def test_with_a_queue_a_certificate_needs_a_stated_delay() -> None:
    stated = "certificate.network_delay_s=0.003"
    queue = "network.impairments=[{kind='delay',delay_s=0.001},{kind='rate',rate_bps=500000}]"
    for settings, is_certified in (([queue, stated], True), ([queue], False), ([], True)):
        certificate = quick_certificate(resolve(shipped("unstable_pendulum", *settings)))
        assert certificate.exists == is_certified
        if certificate.void is not None:
            assert certificate.void.startswith("certificate.network_delay_s: state the largest delay")


@pytest.mark.parametrize("run", [noack.simulate, noack.run])
def test_no_run_is_made_of_a_scenario_object_with_overload(
    run: Callable[..., object], content: dict[str, Any], tmp_path: Path
) -> None:
    """One that was loaded from no file, or changed afterwards."""
    scenario = scenario_of(content, 1000, 5, {"name": "a", "trigger": PERIODIC})
    with pytest.raises(CallerError, match="the queue would grow without bound"):
        run(scenario, runs=tmp_path / "runs")
    assert not list(tmp_path.glob("runs/*"))

"""Requests to change a run."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cosim.live.coordination import change_requests
from cosim.live.coordination.change_requests import ChangeRequests
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from noack.scenario.resolution import ResolvedRun
from noack.scenario.scenario_file import load

SHARED = Path(__file__).parents[4] / "scenarios" / "shared_bottleneck.toml"


def requests_of(loops: str, *settings: str) -> ChangeRequests:
    run = ResolvedRun(load(SHARED, [f"loops=[{loops}]", *settings]))
    plane = SimpleNamespace(announce_change=lambda announcement: None)
    return ChangeRequests(run, "here", cast("Any", plane))


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


def test_the_answer_has_the_threshold_without_and_with_the_change() -> None:
    """β = 0.5 and α = 0.25 /s at first. α changes at 4 s, β at 6 s: the level is βe^(−∫α dt)."""
    settings = 'trigger={policy="decaying", beta=0.5, alpha_per_s=0.25}'
    requests = requests_of('{ name = "p" }', settings)
    slower = requested(requests, {"trigger.alpha_per_s": 0.1}, 3.8)["thresholds"]
    halved = requested(requests, {"trigger.beta": 0.25}, 5.8)["thresholds"]
    assert slower == {"p": pytest.approx((0.5 * math.exp(-1.0),) * 2, rel=1e-12)}
    level = 0.5 * math.exp(-1.0 - 0.1 * 2.0)
    assert halved == {"p": pytest.approx((level, level / 2), rel=1e-12)}
    assert requested(requests, {"network.mansd": 2}, 7.0)["thresholds"] == {}


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


def test_a_change_with_which_a_link_must_overflow_is_refused() -> None:
    """At 20 updates per second of 93 bytes with their headers, one of four passes with M − 1 = 3."""
    rate = 'network.impairments=[{ kind = "rate", rate_bps = 8000, queue = 5 }]'
    trigger = 'trigger={policy="periodic", period_s=0.05}'
    requests = requests_of('{ name = "p" }', rate, trigger)
    with pytest.raises(CallerError, match=r"the change: network\.impairments\.0: .* the queue would grow"):
        requested(requests, {"network.mansd": 0})
    assert requests.announced == ()
    assert requested(requests, {"network.mansd": 2})["from_s"] > 0


def test_a_change_beyond_the_last_one_or_the_end_of_the_run_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    requests, settings = requests_of('{ name = "p" }'), {"network.mansd": 2}
    monkeypatch.setattr(change_requests, "MOST_CHANGES", 2)
    for _ in range(2):
        requested(requests, settings)
    with pytest.raises(CallerError, match="this run has had 2 changes, the maximum"):
        requested(requests, settings)
    assert len(requests.announced) == 2
    with pytest.raises(CallerError, match=r"the run ends at 0\.1 s, before a change could apply"):
        requested(requests_of('{ name = "p" }', "horizon_s=0.1"), settings)

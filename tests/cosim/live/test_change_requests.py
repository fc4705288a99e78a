"""Requests to change a run: what is listed can be changed."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cosim.live.coordinator import ChangeRequests
from noack.core.errors import CallerError
from noack.scenario.scenario_file import load

PATH = Path(__file__).parents[3] / "scenarios" / "shared_bottleneck.toml"


def requests_of(loops: int | str, *settings: str) -> ChangeRequests:
    entries = loops if isinstance(loops, str) else f'[{{ name = "p", count = {loops} }}]'
    scenario = load(PATH, [f"loops={entries}", *settings])
    ticket = SimpleNamespace(scenario=scenario, run_dir="here")
    plane = SimpleNamespace(announce_change=lambda announcement: None)
    return ChangeRequests(cast("Any", ticket), cast("Any", plane))


def requested(requests: ChangeRequests, settings: dict[str, Any]) -> dict[str, Any]:
    return requests.answer(json.dumps({"settings": settings}).encode(), lambda: 0, None).fields()


def answer(loops: int, settings: dict[str, Any]) -> dict[str, Any]:
    return requested(requests_of(loops), settings)


@pytest.mark.parametrize("loops", [1, 4])
def test_every_listed_parameter_can_be_changed(loops: int) -> None:
    listed = answer(loops, {})["runtime_parameters"]
    assert {"trigger.beta", "network.mansd", "controller.setpoint"} <= listed.keys()
    for key, value in listed.items():
        assert answer(loops, {key: value})["from_s"] > 0


def test_each_entry_of_the_loops_has_its_own_values() -> None:
    requests = requests_of('[{ name = "p", count = 3 }, { name = "q", trigger = { beta = 0.07 } }]')
    before = requested(requests, {})
    assert before["loops"]["q"]["trigger.beta"] == 0.07
    assert before["loops"]["p"] == before["runtime_parameters"]
    assert before["changed_loops"] == ()
    after = requested(requests, {"trigger.beta": 0.07})
    assert after["changed_loops"] == ("p",)
    assert after["loops"]["p"] == after["loops"]["q"]


def test_other_settings_are_refused() -> None:
    with pytest.raises(CallerError, match=r"plant\.rate_hz"):
        answer(4, {"plant.rate_hz": 100.0})


def test_a_refused_change_has_no_effect_on_the_next_one() -> None:
    """It is valid now and with the last settings, but not with the first of those scheduled."""
    requests = requests_of(2, 'changes=[{ at_s = 8.0, set = { "network.mansd" = 2 } }]')
    kept = {"model": "bernoulli", "probability": 0.8, "keep": True}
    with pytest.raises(CallerError, match=r"network\.loss: loss 80% keep: impossible"):
        requested(requests, {"network.mansd": 10, "network.loss": kept})
    loss = kept | {"probability": 0.2}
    assert requested(requests, {"network.loss": loss})["from_s"] > 0
    found = requested(requests, {})["runtime_parameters"]
    assert (found["network.mansd"], found["network.loss"]["probability"]) == (2, 0.2)
    assert [one.number for one in requests.announced] == [0, 1]

"""Requests to change a run: what is listed can be changed."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cosim.live.coordinator import ChangeRequests
from noack.config.scenario_file import load
from noack.core.errors import CallerError

PATH = Path(__file__).parents[3] / "scenarios" / "shared_bottleneck.toml"


def answer(loops: int, settings: dict[str, Any]) -> dict[str, Any]:
    scenario = load(PATH, [f'loops=[{{ name = "p", count = {loops} }}]'])
    ticket = SimpleNamespace(scenario=scenario, run_dir="here")
    plane = SimpleNamespace(announce_change=lambda announcement: None)
    requests = ChangeRequests(cast("Any", ticket), cast("Any", plane))
    return requests.answer(json.dumps({"settings": settings}).encode(), lambda: 0, None)


@pytest.mark.parametrize("loops", [1, 4])
def test_every_listed_parameter_can_be_changed(loops: int) -> None:
    listed = answer(loops, {})["runtime_parameters"]
    assert {"trigger.beta", "network.mansd", "controller.setpoint"} <= listed.keys()
    for key, value in listed.items():
        assert answer(loops, {key: value})["from_s"] > 0


def test_other_settings_are_refused() -> None:
    with pytest.raises(CallerError, match=r"plant\.rate_hz"):
        answer(4, {"plant.rate_hz": 100.0})

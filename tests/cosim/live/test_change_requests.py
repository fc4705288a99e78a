"""Requests to change a run: only what this run can change is listed."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cosim.live.change_requests import ChangeRequests
from noack.config.scenario_file import load
from noack.core.errors import CallerError

PATH = Path(__file__).parents[3] / "scenarios" / "shared_bottleneck.toml"


def answer(loops: int, settings: dict[str, Any]) -> dict[str, Any]:
    scenario = load(PATH, [f'loops=[{{ name = "p", count = {loops} }}]'])
    ticket = SimpleNamespace(scenario=scenario, run_dir="here")
    plane = SimpleNamespace(announce_change=lambda announcement: None)
    requests = ChangeRequests(cast("Any", ticket), cast("Any", plane))
    return requests.answer(json.dumps({"settings": settings}).encode(), lambda: 0, None)


@pytest.mark.parametrize("loops", [3, 4])
def test_every_listed_parameter_can_be_changed_and_no_other(loops: int) -> None:
    everything = answer(3, {})["runtime_parameters"]
    listed = answer(loops, {})["runtime_parameters"]
    assert ("trigger.beta" in listed) == (loops == 3)
    for key, value in everything.items():
        if key in listed:
            assert answer(loops, {key: value})["from_s"] > 0
        else:
            with pytest.raises(CallerError, match="only network"):
                answer(loops, {key: value})

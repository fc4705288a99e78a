"""Measurements and observers of a scenario; mistakes in them: mistakes.txt."""

import tomllib
from typing import Any

import pytest

from noack.core.errors import CallerError
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import dumps, validate

POSITION: dict[str, Any] = {"C": [[1.0, 0.0]], "noise_std": [0.01]}


def test_a_state_disturbance_needs_a_linear_plant(content: dict[str, Any]) -> None:
    content["model"] = {
        "A": [[0.0] * 4] * 4, "B": [[0.0]] * 4, "gain": [[0.0] * 4], "allow_unstable": True,
    }  # fmt: skip
    content["plant"] = {
        "system": {"kind": "cart_pole"}, "initial_state": [0.0] * 4,
        "disturbances": [{"kind": "uniform", "at": "state", "bound": [1.0] * 4}],
    }  # fmt: skip
    with pytest.raises(CallerError, match=r"^file: plant.disturbances.0.at = .* a linear plant"):
        validate(content, "file")


def test_a_resolved_scenario_has_its_gain_and_resolves_to_itself(content: dict[str, Any]) -> None:
    content["plant"]["measurement"] = POSITION
    content["observer"] = {"kind": "luenberger", "poles_per_s": [[-5.0, 1.0]]}
    once = resolve(validate(content, "file"))
    assert once.observer is not None
    assert once.observer.kind == "luenberger"
    assert once.observer.gain is not None
    again = validate(tomllib.loads(dumps(once)), "again")
    assert again == once == resolve(again)

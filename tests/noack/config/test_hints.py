"""The error message for a common mistake suggests the right value, and the suggestion is valid."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

import noack
from noack.core.errors import CallerError

DOUBLE = """
name = "double"
horizon_s = 1.0
model = { A = [[0, 1], [0, 0]], B = [[0], [1]], gain = [[-1, -1.5]] }
plant = { initial_state = [1, 0] }
trigger = { beta = 0.5, alpha_per_s = 0.25 }
network = { mansd = 2, loss = { model = "bernoulli", probability = 0.5 } }
"""


class Car:
    """A user's plant class; only its name is used."""


@pytest.mark.parametrize("key", ["plant.system", "plant.system.name", "plant.system.file"])
def test_class_is_converted_to_its_file_and_name(
    key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content: dict[str, Any] = {"plant.system": {"kind": "python", "name": "Car"}}
    with pytest.raises(CallerError) as caught:
        noack.load("double_integrator", content | {key: Car})
    _, found, written = str(caught.value).partition(
        "Car: a class is given by its file and its name: "
    )
    assert found
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_plant.py").write_text("class Car: pass")
    scenario = tomllib.loads(DOUBLE)
    loaded = noack.load(scenario, {"plant.system": json.loads(written)})
    assert (loaded.plant.system.kind, loaded.plant.system.name) == ("python", "Car")
    with pytest.raises(CallerError, match=r"a value of type Car is no value of a setting$"):
        noack.load("double_integrator", {"plant.system": Car()})

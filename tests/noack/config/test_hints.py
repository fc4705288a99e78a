"""The error message for a common mistake suggests the right value, and the suggestion is valid."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

import noack
from noack.config.scenario_file import load
from noack.core.errors import CallerError

DOUBLE = """
name = "double"
horizon_s = 1.0
model = { A = [[0, 1], [0, 0]], B = [[0], [1]], gain = [[-1, -1.5]] }
plant = { initial_state = [1, 0] }
trigger = { beta = 0.5, alpha_per_s = 0.25 }
network = { mansd = 2, loss = { model = "bernoulli", probability = 0.5 } }
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "double.toml").write_text(DOUBLE)
    return tmp_path / "double.toml"


def mistake(path: Path, *settings: str) -> str:
    """The line of the error message."""
    with pytest.raises(CallerError, match=r"^[^\n]*$") as caught:
        load(path, settings)
    return str(caught.value)


@pytest.mark.parametrize(
    ("setting", "hint", "before"),
    [
        ("model.B=[[0, 1]]", "looks transposed: try ", []),
        ("model.gain=[[-1], [-1.5]]", "looks transposed: try ", []),
        ("plant.B=[[0, 1]]", "looks transposed: try ",
         ["plant.draw=given", "plant.A=[[0, 1], [0, 0]]"]),
        ('plant.initial_state="1, 0"', "a list of numbers, e.g. ", []),
        ("model.A=1", "a matrix is a list of rows, e.g. ", []),
        ('model.A=["0 1", [0, 0]]', "a matrix is a list of rows, e.g. ", []),
        ("model.state_names=position", "a list of names, e.g. ", []),
        ('network.loss={model="scripted",lost=3}', "a list of numbers, e.g. ", []),
        ("network.loss.probability=80", "80 % is ", []),
        ("network.loss.probability=80%", "80 % is ", []),
        ('network.loss.probability="12.5 %"', "12.5 % is ", []),
        ("network.loss.correlation=30%", "30 % is ", []),
    ],
)  # fmt: skip
def test_hint_is_what_would_be_right(
    path: Path, setting: str, hint: str, before: list[str]
) -> None:
    message = mistake(path, *before, setting)
    begin, found, right = message.partition(hint)
    assert found, message
    key = begin.removeprefix("--set ").partition(" = ")[0].removesuffix(".0")
    tomllib.loads(f"value = {right}")
    value = f'{{model="scripted",lost={right}}}' if key == "network.loss.lost" else right
    setting = f"{key.removesuffix('.lost')}={value}"
    load(path, [*before, "model.allow_unstable=true", setting])  # the hint concerns the form only


@pytest.mark.parametrize(
    "setting",
    [
        "network.loss.probability=800",  # not a percentage
        "network.loss.probability=-80",
        "network.loss.probability=true",
        "network.loss.probability=much",
        "horizon_s=80%",  # not a share
        "model.B=[[0, 1, 2]]",  # wrong in either order
    ],
)
def test_no_invalid_value_is_suggested(path: Path, setting: str) -> None:
    message = mistake(path, setting)
    assert "% is" not in message
    assert "transposed" not in message


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

"""The JSON Schema of scenario files, which editors use."""

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from noack.config.scenario import Scenario
from noack.config.toml_file import json_schema

ROOT = Path(__file__).parents[3]
SHIPPED = sorted((ROOT / "scenarios").glob("*.toml"))


def test_the_published_scenario_schema_is_up_to_date() -> None:
    """``noack schema > docs/scenario.schema.json`` updates it."""
    published = (ROOT / "docs" / "scenario.schema.json").read_text(encoding="utf-8")
    assert json.loads(published) == json_schema(Scenario)


def test_every_key_is_described() -> None:
    schema = json_schema(Scenario)
    sections = {"Scenario": schema, **schema["$defs"]}
    bare = [
        f"{name}.{key}"
        for name, section in sections.items()
        for key, entry in section.get("properties", {}).items()
        # A section is described where it is defined; a loss model's "model" is its name.
        if not ({"description", "$ref", "const"} & set(entry) or "$ref" in json.dumps(entry))
    ]
    assert bare == []
    assert all("description" in section for section in sections.values())
    assert set(schema["properties"]) == set(Scenario.model_fields)


@pytest.fixture(scope="module")
def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator.check_schema(json_schema(Scenario))
    return jsonschema.Draft202012Validator(json_schema(Scenario))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenarios_are_valid(validator: Any, path: Path) -> None:
    assert [error.message for error in validator.iter_errors(tomllib.loads(path.read_text()))] == []


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("sped", 1),
        ("mode", "modl"),
        ("name", "two words"),
        ("horizon_s", 0),
        ("horizon_s", "20 s"),
        ("trigger.bta", 1),
        ("trigger.beta", -1),
        ("trigger.weight", 3),
        ("plant.initial_state", []),
        ("plant.initial_state", ["x"]),
        ("plant.measure_every", 0),
        ("network.mansd", 1.5),
        ("network.mansd", -1),
        ("network.loss", {"model": "bernouli", "probability": 0.5}),
        ("network.loss", {"model": "bernoulli"}),
        ("network.loss", {"model": "lossless", "probability": 0.5}),
        ("network.loss", {"model": "bernoulli", "probability": 1.5}),
        ("ports", {"plant": 70000}),
        ("trigger", None),
    ],
)
def test_the_schema_refuses_mistakes(
    validator: Any, content: dict[str, Any], key: str, value: object
) -> None:
    assert validator.is_valid(content)
    spoilt = copy.deepcopy(content)
    *path, last = key.split(".")
    section = spoilt
    for part in path:
        section = section[part]
    if value is None:
        del section[last]
    else:
        section[last] = value
    assert not validator.is_valid(spoilt)

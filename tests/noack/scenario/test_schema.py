"""The JSON Schema of scenario files."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from netem.core.toml_file import json_schema
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import put, value_of

ROOT = Path(__file__).parents[3]
SHIPPED = sorted((ROOT / "scenarios").glob("*.toml"))


SCHEMA = json_schema(Scenario)


def test_every_key_is_described() -> None:
    sections = {"Scenario": SCHEMA, **SCHEMA["$defs"]}
    bare = [
        f"{name}.{key}"
        for name, section in sections.items()
        for key, entry in section.get("properties", {}).items()
        # A section is described where it is defined; a loss model's "model" is its name.
        if not ({"description", "$ref", "const"} & set(entry) or "$ref" in json.dumps(entry))
    ]
    assert bare == []
    assert all("description" in section for section in sections.values())
    assert set(SCHEMA["properties"]) == set(Scenario.model_fields)


@pytest.fixture(scope="module")
def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    return jsonschema.Draft202012Validator(SCHEMA)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenarios_are_valid(validator: Any, path: Path) -> None:
    assert [error.message for error in validator.iter_errors(tomllib.loads(path.read_text()))] == []


@pytest.mark.parametrize(
    "settings",
    [
        "sped=1",
        'name="two words"',
        "horizon_s=0",
        "trigger.bta=1",
        'network.loss={model="bernoulli"}',
        'network.loss={model="lossless",probability=0.5}',
    ],
)
def test_the_schema_refuses_mistakes(validator: Any, content: dict[str, Any], settings: str) -> None:
    assert validator.is_valid(content)
    key, _, value = settings.partition("=")
    put(content, key, value_of(value, key), key)
    assert not validator.is_valid(content)

"""The JSON Schema of scenario files, which editors use."""

import inspect
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from netem.tc_words import LinksFile
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import put, value_of
from noack.scenario.toml_file import json_schema
from noack.settings import section as section_module
from noack.settings.section import ScenarioSection

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
def test_the_schema_refuses_mistakes(
    validator: Any, content: dict[str, Any], settings: str
) -> None:
    assert validator.is_valid(content)
    key, _, value = settings.partition("=")
    put(content, key, value_of(value, key), key)
    assert not validator.is_valid(content)


def real_numbers(schema: Any) -> Iterator[Any]:
    if isinstance(schema, dict):
        if schema.get("type") == "float":
            yield schema
        schema = list(schema.values())
    if isinstance(schema, list | tuple):
        for part in schema:
            yield from real_numbers(part)


@pytest.mark.parametrize("file", [Scenario, LinksFile])
def test_no_setting_accepts_infinity_or_nan(file: type[ScenarioSection]) -> None:
    """The JSON Schema cannot express it."""
    file.model_rebuild()
    found = list(real_numbers(file.__pydantic_core_schema__))
    assert len(found) > 20
    assert {one.get("allow_inf_nan") for one in found} == {False}


def test_sections_without_their_source_have_no_descriptions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(inspect, "getsource", Mock(side_effect=OSError("no source")))
    assert section_module._docstrings.__wrapped__("noack.scenario.scenario") == {}

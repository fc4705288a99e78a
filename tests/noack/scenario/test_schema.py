"""The JSON Schema of scenario files, and properties of every kind in the registries."""

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.analysis.replay import replay
from cosim.simulation.virtual_time import simulate
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import put, validate, value_of
from noack.scenario.sections import DISTURBANCES, OBSERVERS, POLICIES
from noack.scenario.toml_file import json_schema

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


# --- every kind -----------------------------------------------------------------------------------


def cases() -> Iterator[Any]:
    """The changed sections of the small scenario, which has two states and one input."""
    for name, policy in POLICIES.items():
        if (example := policy.example(2)) is not None:
            table = example.model_dump(mode="json", exclude_none=True)
            yield pytest.param({"trigger": table}, id=f"trigger-{name}")
    for name, disturbance in DISTURBANCES.items():
        yield pytest.param({"plant": {"disturbances": [disturbance.example]}}, id=f"disturbance-{name}")
    measurement = {"C": [[1.0, 0.0]], "noise_std": [0.01]}
    for name, observer in OBSERVERS.items():
        sections = {"plant": {"measurement": measurement}, "observer": observer.example}
        yield pytest.param(sections, id=f"observer-{name}")


@pytest.mark.parametrize("sections", list(cases()))
def test_a_scenario_of_each_kind_is_unchanged_by_json_and_repeats_bit_for_bit(
    content: dict[str, Any], sections: dict[str, Any]
) -> None:
    plant = content["plant"] | {"rate_hz": 100.0} | sections.get("plant", {})
    made = validate(content | {"horizon_s": 0.5} | sections | {"plant": plant}, "here")
    assert Scenario.model_validate_json(made.model_dump_json()) == made
    assert len(made.trigger.description.splitlines()) == 1
    resolved = resolve(made)
    record = simulate(resolved)
    assert len(record["sensor_measurement"]) == 51
    assert replay(record).bit_exact

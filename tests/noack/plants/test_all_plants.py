"""Properties of every kind of plant that has a shipped scenario."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.plants.plant_settings import PlantSettings
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.scenario.sections import PLANTS
from plant_server.plant import system_of
from tests.noack.plants.motion import motion

ROOT = Path(__file__).parents[3]
STEPS = 25


def cases() -> Iterator[Any]:
    for kind, settings in PLANTS.items():
        for variant in settings.variants if settings.scenario else ():
            overrides = [f"plant.system.{key}={value}" for key, value in variant.items()]
            yield pytest.param(settings.scenario, overrides, id="-".join([kind, *overrides]))


def scenario_of(name: str, overrides: list[str]) -> Scenario:
    return resolve(load(ROOT / "scenarios" / f"{name}.toml", overrides))


def moved(scenario: Scenario, inputs: np.ndarray) -> np.ndarray:
    return motion(system_of(scenario), inputs, scenario.timing.plant_period_ns)


@pytest.mark.parametrize(("name", "overrides"), list(cases()))
def test_the_operating_point_is_an_equilibrium(name: str, overrides: list[str]) -> None:
    n, m = scenario_of(name, []).model.dimensions
    at_rest = scenario_of(name, [*overrides, f"plant.initial_state={[0.0] * n}"])
    states = moved(at_rest, np.zeros((STEPS, m)))
    np.testing.assert_allclose(states, 0.0, atol=1e-3)  # the drift model's wheels start to slip


@pytest.mark.parametrize(("name", "overrides"), list(cases()))
def test_the_same_inputs_give_bit_identical_states(name: str, overrides: list[str]) -> None:
    scenario = scenario_of(name, overrides)
    inputs = 0.01 * np.random.default_rng(1).normal(size=(STEPS, scenario.model.dimensions[1]))
    first = moved(scenario, inputs)
    moved(scenario, -inputs)
    assert np.isfinite(first).all()
    assert moved(scenario, inputs).tobytes() == first.tobytes()


def row(kind: str, settings: type[PlantSettings]) -> str:
    summary = (settings.__doc__ or "").partition("\n")[0].removesuffix(".")
    states, inputs = ("; ".join(names) or "any" for names in (settings.states, settings.inputs))
    scenario = f"`{settings.scenario}`" if settings.scenario else ""
    return f"| `{kind}` | {summary} | {states} | {inputs} | {scenario} |"


def test_the_documented_keys_are_those_of_the_settings() -> None:
    """docs/scenarios.md has a row per kind, with every key and some defaults."""
    text = (ROOT / "docs/scenarios.md").read_text()
    section = text[text.index("\n## Plants\n") : text.index("\n### Vehicles\n")]
    for kind, settings in PLANTS.items():
        row = next(line for line in section.splitlines() if line.startswith(f"| `{kind}` |"))
        keys = dict(re.findall(r"`(\w+)(?: = ([^`]+))?`", row.split("|")[-2]))
        fields = {key: field for key, field in settings.model_fields.items() if key != "kind"}
        assert keys.keys() == fields.keys(), kind
        for key, default in keys.items():
            if default:
                assert tomllib.loads(f"value = {default}")["value"] == list_of(fields[key].default)


def list_of(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def test_the_documented_kinds_are_those_of_the_registry() -> None:
    text = (ROOT / "docs/plants.md").read_text()
    for kind, settings in PLANTS.items():
        assert row(kind, settings) in text

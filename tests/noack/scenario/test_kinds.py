"""Properties of every kind in the registries of features, in a short run of a small scenario."""

from collections.abc import Iterator
from typing import Any

import pytest

from cosim.analysis.replay import replay
from cosim.simulation.virtual_time import simulate
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.scenario.sections import DISTURBANCES, OBSERVERS, POLICIES


def cases() -> Iterator[Any]:
    """The changed sections of the small scenario, which has two states and one input."""
    for name, policy in POLICIES.items():
        if (example := policy.example(2)) is not None:
            table = example.model_dump(mode="json", exclude_none=True)
            yield pytest.param({"trigger": table}, id=f"trigger-{name}")
    for name, disturbance in DISTURBANCES.items():
        yield pytest.param(
            {"plant": {"disturbances": [disturbance.example]}}, id=f"disturbance-{name}"
        )
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

"""Scenarios from files, tables and matrices, and the messages for mistakes."""

from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

import noack
from noack.scenario.scenario_file import dumps
from tests.cosim.api.conftest import GAIN, SYSTEM, TRUE


def test_a_scenario_loads_equally_by_name_file_and_table(tmp_path: Path) -> None:
    shipped = noack.load("double_integrator")
    path = tmp_path / "own.toml"
    path.write_text(dumps(shipped))
    assert noack.load(path) == noack.load(str(path)) == shipped
    assert noack.load(shipped.model_dump(mode="json", exclude_none=True)) == shipped
    assert noack.load(shipped) is shipped


def test_files_are_found_relative_to_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: dict[str, Any]
) -> None:
    np.savez(tmp_path / "model.npz", A=SYSTEM[0], B=SYSTEM[1], K=GAIN)
    content["model"] = {"file": "model.npz"}
    monkeypatch.chdir(tmp_path)
    assert noack.load(content).model.matrices[0].tolist() == SYSTEM[0]


def test_settings_replace_values_in_a_copy_of_the_scenario() -> None:
    scenario = noack.load("lane_following")
    other = noack.with_settings(
        scenario,
        {
            "network.mansd": np.int64(9),
            "network.loss": {"model": "bernoulli", "probability": np.float64(0.9)},
            "trigger.weight": np.eye(4),
            "seeds": None,
        },
    )
    assert (other.network.mansd, scenario.network.mansd) == (9, 4)
    assert other.network.loss.model_dump()["probability"] == 0.9
    assert other.trigger.weight == tuple(map(tuple, np.eye(4)))
    assert (other.seeds.plant, scenario.seeds.plant) == (0, 1)
    assert noack.load("lane_following", {"network.mansd": 9}).network.mansd == 9


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"network.loss.probabilty": 0.8}, "did you mean probability?"),
        ({"network.loss.probability": 1.8}, "settings: network.loss.probability = 1.8: should be"),
        ({"horizon_s": None}, "settings: horizon_s: missing (simulated length of the run)"),
        ({"horizon_s.x": 1}, "settings: horizon_s.x: horizon_s is not a table"),
        ({"plant.initial_state": np.zeros(3)}, "plant.initial_state"),
        ({"horizon_s": object()}, "is no value of a setting"),
    ],
)
def test_a_wrong_setting_gives_one_line(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(noack.NoackError) as caught:
        noack.with_settings(noack.load("lane_following"), settings)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_scenario_name_gives_one_line() -> None:
    with pytest.raises(noack.NoackError, match="lane_folowing") as caught:
        noack.load("lane_folowing")
    assert "lane_following" in str(caught.value)


def test_settings_that_are_no_table_give_one_line() -> None:
    given: Any = ["network.mansd=2"]
    with pytest.raises(noack.NoackError, match=r"^settings: \['network.mansd=2'\] is no table"):
        noack.load("lane_following", given)


def test_a_key_that_is_no_text_gives_one_line() -> None:
    given: Any = {3: 1}
    with pytest.raises(noack.NoackError, match=r"^settings: 3 is not a key"):
        noack.load("lane_following", given)


def test_a_system_becomes_a_scenario_with_the_documented_choices() -> None:
    scenario = noack.from_system(SYSTEM, GAIN, [3.0, 4.0])
    decay_per_s = -np.linalg.eigvals(np.add(SYSTEM[0], np.matmul(SYSTEM[1], GAIN))).real.max()
    trigger = scenario.decaying
    assert trigger.alpha_per_s == pytest.approx(decay_per_s / 2, rel=5e-3)
    assert trigger.beta == 0.5
    assert np.exp(-trigger.alpha_per_s * scenario.horizon_s) == pytest.approx(0.01, rel=0.03)
    assert scenario.network.mansd == 4
    assert scenario.network.loss.model_dump()["probability"] == 0.5
    assert scenario.plant.draw == "nominal"
    assert noack.from_system(SYSTEM, GAIN, [0, 0]).decaying.beta == 0.1


def test_a_python_control_system_keeps_its_names_and_may_have_another_plant() -> None:
    system = control.ss(
        *SYSTEM, np.eye(2), np.zeros((2, 1)), states=["angle", "rate"], inputs=["torque"]
    )
    scenario = noack.from_system(
        system, GAIN, np.array([0.2, 0.0]), plant=TRUE, settings={"trigger.beta": 0.01}, name="own"
    )
    assert scenario.model.state_names == ("angle", "rate")
    assert np.array(scenario.plant.A).tolist() == TRUE[0]
    assert (scenario.name, scenario.decaying.beta) == ("own", 0.01)


@pytest.mark.parametrize(
    ("gain", "initial_state", "message"),
    [
        ([[15.0, 5.0]], [0.2, 0.0], "give -K"),
        ([[0.0, 0.0]], [0.2, 0.0], "has an eigenvalue with real part 3.08 /s; give a gain"),
        (GAIN, [0.2], "plant.initial_state"),
        (GAIN, "upright", "plant.initial_state"),
    ],
)
def test_an_invalid_system_gives_one_line(gain: Any, initial_state: Any, message: str) -> None:
    with pytest.raises(noack.NoackError) as caught:
        noack.from_system(SYSTEM, gain, initial_state)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_notebook_shows_a_short_form_of_a_scenario() -> None:
    scenario = noack.load("lane_following")
    table = scenario._repr_html_()
    for word in ("lane_following", "beta = 0.5", "bernoulli", "M − 1 = 4", "20 s"):
        assert word in str(scenario)
        assert word in table
    assert len(str(scenario).splitlines()) < 10
    assert table.startswith("<table>")
    harmless = noack.with_settings(scenario, {"description": "<script>"})._repr_html_()
    assert "<script>" not in harmless

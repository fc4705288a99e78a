"""Scenarios from files, tables and matrices, and the messages for mistakes."""

from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

import noack
from tests.cosim.api.conftest import GAIN, SYSTEM, TRUE


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"network.loss.probabilty": 0.8}, "did you mean probability?"),
        ({"network.loss.probability": 1.8}, "settings: network.loss.probability = 1.8: expected"),
        ({"horizon_s": None}, "settings: horizon_s: missing (simulated length of the run)"),
        ({"horizon_s.x": 1}, "settings: horizon_s.x: horizon_s is not a table"),
        ({"plant.initial_state": np.zeros(3)}, "plant.initial_state"),
        ({"horizon_s": object()}, "cannot be the value of a setting"),
        (["network.mansd=2"], "settings: ['network.mansd=2'] is not a table"),
        ({3: 1}, "settings: 3 is not a key"),
    ],
)
def test_a_wrong_setting_gives_one_line(settings: Any, message: str) -> None:
    with pytest.raises(noack.NoackError) as error:
        noack.with_settings(noack.load("lane_following"), settings)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


PLANT = "class Plant:\n    def derivative(self, t, x, u):\n        return [x[1], %s * u[0]]\n"


def test_a_changed_file_replaces_what_was_read_from_the_other_one(tmp_path: Path) -> None:
    """Of a program that is its hash, of data its numbers; a hash that is given is kept."""
    for name, factor in (("first", 1.0), ("second", 2.0)):
        (tmp_path / f"{name}.py").write_text(PLANT % factor)
        (tmp_path / f"{name}.csv").write_text(f"t_s,position,speed,u\n0,{factor},0,0\n9,{factor},0,0\n")
        (tmp_path / f"{name}.delays").write_text(f"{factor}ms\n5ms\n")
        (tmp_path / f"{name}.outages").write_text(f"{factor}s 3s\n")
    first, second = str(tmp_path / "first"), str(tmp_path / "second")

    def settings(path: str) -> dict[str, Any]:
        return {
            "horizon_s": 0.1,
            "plant.system": {"kind": "python", "file": f"{path}.py", "name": "Plant"},
            "plant.draw": None,
            "model.state_names": ["position", "speed"],
            "model.input_names": ["u"],
            "controller.reference": [{"kind": "file", "file": f"{path}.csv"}],
            "network.impairments": [
                {"kind": "delay", "distribution": "empirical", "file": f"{path}.delays"},
                {"kind": "blackout", "file": f"{path}.outages"},
            ],
        }

    files = {
        "plant.system.file": f"{second}.py",
        "controller.reference.0.file": f"{second}.csv",
        "network.impairments.0.file": f"{second}.delays",
        "network.impairments.1.file": f"{second}.outages",
    }
    loaded = noack.load("double_integrator", settings(first))
    changed = noack.with_settings(loaded, files)
    assert changed == noack.load("double_integrator", settings(second)) != loaded
    assert noack.simulate(changed).summary
    entry_point = {"plant.system.file": None, "plant.system.name": "package.module:Plant"}
    assert "sha256" not in noack.with_settings(loaded, entry_point).plant.system.content()
    known = {"plant.system.sha256": loaded.plant.system.content()["sha256"], **files}
    with pytest.raises(noack.NoackError, match=r"has changed: its SHA-256 is .*, plant.system.sha256 is "):
        noack.simulate(noack.with_settings(loaded, known))


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
    system = control.ss(*SYSTEM, np.eye(2), np.zeros((2, 1)), states=["angle", "rate"], inputs=["torque"])
    scenario = noack.from_system(
        system, GAIN, np.array([0.2, 0.0]), plant=TRUE, settings={"trigger.beta": 0.01}, name="own"
    )
    assert scenario.model.state_names == ("angle", "rate")
    assert np.array(scenario.plant.A).tolist() == TRUE[0]
    assert (scenario.name, scenario.decaying.beta) == ("own", 0.01)

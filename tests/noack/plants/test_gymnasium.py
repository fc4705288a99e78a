"""Environments of Gymnasium and MuJoCo as plants: maps, the shipped scenarios, mistakes."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import noack
from cosim.analysis.run_summary import linearisation
from cosim.analysis.summary_model import LinearisationPart
from noack.core.errors import CallerError
from noack.plants.gymnasium import GymnasiumSettings
from noack.plants.plant_settings import PlantStart
from noack.scenario.resolution import resolve
from noack.scenario.toml_file import validated
from tests.command_line import invoke
from tests.extras import skip_without_plant

gymnasium = pytest.importorskip("gymnasium", reason="the extra `gymnasium` is not installed")
SCENARIOS = Path(__file__).parents[3] / "scenarios"
STEP_NS = 100_000_000


class Cart(gymnasium.Env):  # type: ignore[misc, name-defined]
    """Two carts: the first one's speed is the first action, the second one is at rest."""

    action_space = gymnasium.spaces.Box(-10.0, 10.0, (2,))
    observation_space = gymnasium.spaces.Box(-100.0, 100.0, (2,))
    dt = 0.1

    def __init__(self) -> None:
        self.pos, self.body, self.name = 0.5, SimpleNamespace(speed=np.zeros((1, 2))), "cart"

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self.body.speed = np.array([[action[0], action[1]]])
        self.pos += self.dt * action[0]
        return self._seen(), 0.0, True, False, {}

    def _seen(self) -> Any:
        return np.array([self.pos, self.body.speed[0, 0]])


gymnasium.register("noack_tests/Cart-v0", Cart)


def settings_of(name: str, **given: Any) -> GymnasiumSettings:
    content = {"kind": "gymnasium", "id": name, **given}
    return validated(GymnasiumSettings, content, "plant.system")


def cart(x0: list[float], m: int = 1, step_ns: int = STEP_NS, **given: Any) -> Any:
    settings = settings_of("noack_tests/Cart-v0", **given)
    n = len(x0)
    return settings.system(PlantStart(np.array(x0), np.zeros((n, n)), np.zeros((n, m)), step_ns))


ATTRIBUTES = {"state": ["pos", "body.speed"], "actuation": [[2.0], [0.5]]}


def test_attributes_are_the_state_and_maps_choose_among_states_and_actions() -> None:
    made = cart([3.0, 1.0], **ATTRIBUTES, entries=[2, 0], operating_state=[0.25, -1.0],
                operating_action=[1.0, 0.0])  # fmt: skip
    np.testing.assert_array_equal(made.x, [3.0, 1.0])
    made.advance(np.array([4.0]), 0, STEP_NS)  # the action is (9, 2)
    np.testing.assert_allclose(made.x, [2.0 - 0.25, 0.0 + 0.9 + 1.0], rtol=1e-15)


def test_an_observation_is_the_state_of_an_environment_that_cannot_be_set() -> None:
    seen = {"state": ["observation"], "actuation": [[1.0], [0.0]], "operating_state": [0.2, 0.0]}
    made = cart([0.3, 0.0], **seen)
    made.advance(np.array([1.0]), 0, STEP_NS)
    np.testing.assert_allclose(made.x, [0.4, 1.0], rtol=1e-15)
    with pytest.raises(CallerError, match=r"cannot be set; set plant.initial_state = \[0.3, 0.0\]"):
        cart([0.4, 0.0], **seen)


@pytest.mark.parametrize(("given", "why"), [
    ({}, r"it has no `state` of numbers; plant.system.state names the attributes"),
    ({"state": ["pos", "name"]}, "it has no `name` of numbers"),
    ({"state": ["pos"], "entries": [0, 1]}, "entries has 1; its state has entries 0 to 0"),
    ({"state": ["pos", "body.speed"]}, "it has 3 states and 2 actions; the model has 2 and 1"),
    (ATTRIBUTES | {"actuation": [[1.0]]}, "it has 2 actions; plant.system.actuation needs as many"),
    (ATTRIBUTES | {"entries": [0, 1], "step_ns": STEP_NS // 20},
     "set plant.rate_hz = 10; it cannot make 20 steps of the plant out of its one"),
    (ATTRIBUTES | {"entries": [0, 1], "step_ns": 5 * STEP_NS},
     "set plant.rate_hz = 10 and plant.measure_every = 5 to measure as often as now"),
    (ATTRIBUTES | {"file": "none.xml"}, r'file = "none.xml": cannot be read: No such file'),
])  # fmt: skip
def test_a_mistake_in_the_maps_is_one_line(given: Any, why: str) -> None:
    with pytest.raises(CallerError, match=why) as caught:
        cart([0.0, 0.0], **given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("given", "why"), [
    ({"entries": [0, 0]}, "an entry is there twice"),
    ({"entries": [0]}, "entries: expected 2 entries"),
    ({"actuation": [[1.0, 2.0]]}, "actuation: expected 1 x 1"),
    ({"operating_state": [1.0]}, "operating_state: expected 2 entries"),
])  # fmt: skip
def test_maps_of_another_size_than_the_model_are_refused(given: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        settings_of("any", **given).check(2, 1)


def test_without_mujoco_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("noack.plants.gymnasium.find_spec", lambda name: None)
    with pytest.raises(CallerError, match=r"^plant.system.id: .*pip install 'noack\[mujoco\]'$"):
        settings_of("Hopper-v5").require_installed()


def columns(run: noack.Run) -> np.ndarray:
    table = run.table("plant_step")
    return np.array([table[f"x_{i}"] for i in range(1, 5)])


def test_mujocos_cart_pole_agrees_with_noacks() -> None:
    """MuJoCo's Runge-Kutta steps of 2 ms against adaptive ones; A in closed form."""
    skip_without_plant(SCENARIOS / "cart_pole_mujoco.toml")
    ours, theirs = (noack.simulate(name) for name in ("cart_pole", "cart_pole_mujoco"))
    np.testing.assert_allclose(columns(theirs), columns(ours), atol=1e-7)
    assert theirs.replay().bit_exact
    found = linearisation(resolve(theirs.scenario))
    assert isinstance(found, LinearisationPart)
    assert np.abs(found.off_A).max() < 1e-6
    linear = json.loads(invoke("linearise", "cart_pole_mujoco", "--json").stdout)
    model = theirs.scenario.model
    np.testing.assert_allclose(linear["A"], model.A, atol=1e-6)
    np.testing.assert_allclose(linear["B"], model.B, atol=1e-6)


def test_a_motion_that_diverges_is_not_reset(tmp_path: Path, monkeypatch: Any) -> None:
    """MuJoCo would put the state of such a motion back to 0, and the loop would go on."""
    skip_without_plant(SCENARIOS / "cart_pole_mujoco.toml")
    monkeypatch.chdir(tmp_path)  # in which MuJoCo writes a log
    settings = settings_of("InvertedPendulum-v5")
    start = PlantStart(np.array([0, 0.1, 0, 1e150]), np.zeros((4, 4)), np.zeros((4, 1)), 40_000_000)
    made = settings.system(start)
    made.advance(np.zeros(1), 0, 40_000_000)
    assert np.isnan(made.x).all()


@pytest.mark.parametrize("name", ["cart_pole_mujoco", "double_pendulum_mujoco"])
def test_a_live_run_is_replayed_bit_for_bit(name: str, tmp_path: Path) -> None:
    skip_without_plant(SCENARIOS / f"{name}.toml")
    short = ["--set", "horizon_s=1", "--set", "ports={}", "--runs", tmp_path, "--no-report"]
    done = invoke("run", name, *short)
    assert done.exit_code == 0, done.output
    (folder,) = (path for path in tmp_path.iterdir() if path.name != "latest")
    assert (folder / "plant").exists() == (name == "cart_pole_mujoco")  # a copy of its model
    replayed = invoke("replay", folder)
    assert replayed.exit_code == 0, replayed.output
    assert "bit" in replayed.output

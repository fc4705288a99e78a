"""Environments of Gymnasium and MuJoCo as plants: maps, the shipped scenarios, mistakes."""

import json
import math
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy.linalg import expm, logm

import noack
from cosim.analysis.summary.plant_linearisation import linearisation
from cosim.analysis.summary.summary_model import LinearisationPart
from netem.core.errors import CallerError
from netem.core.toml_file import validated
from noack.extend import PlantStart, SystemFailedError
from noack.plants.systems.linearisation import linearise
from noack.scenario.resolution import resolve
from noack_gymnasium.gymnasium_plant import GymnasiumSettings
from tests.helpers.approved import compare_lines, lines_of_error
from tests.helpers.command_line import invoke

needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="the extra `mujoco` is not installed")
STEP_NS = 100_000_000


class Cart(gymnasium.Env):  # type: ignore[type-arg]
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


def test_a_mistake_gives_the_approved_line() -> None:
    """Of a loop with two states and one input, in steps of 0.1 s, unless the line says otherwise."""

    def mistake(line: str) -> list[str]:
        given = {"id": "noack_tests/Cart-v0"} | json.loads(line)
        n, m, step_ns = given.pop("n", 2), given.pop("m", 1), given.pop("step_ns", STEP_NS)
        start = PlantStart(np.zeros(n), np.zeros((n, n)), np.zeros((n, m)), step_ns)
        settings = settings_of(given.pop("id"), **given)
        try:
            settings.check(n, m)
        except ValueError as error:
            return [str(error)]
        return lines_of_error(lambda: settings.system(start))

    compare_lines(Path(__file__).with_name("gymnasium_mistakes.txt"), mistake)


def test_without_mujoco_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("noack_gymnasium.gymnasium_plant.find_spec", lambda name: None)
    with pytest.raises(CallerError, match=r"^plant.system.id: .*pip install 'noack-gymnasium\[mujoco\]'$"):
        settings_of("Hopper-v5").environment()


def columns(run: noack.Run) -> np.ndarray:
    table = run.table("plant_step")
    return np.array([table[f"x_{i}"] for i in range(1, 5)])


@needs_mujoco
def test_mujocos_cart_pole_agrees_with_noacks() -> None:
    """MuJoCo's Runge-Kutta steps of 2 ms against adaptive ones; A in closed form."""
    ours, theirs = (noack.simulate(name) for name in ("cart_pole", "cart_pole_mujoco"))
    np.testing.assert_allclose(columns(theirs), columns(ours), atol=1e-7)
    assert theirs.replay().bit_exact
    part = linearisation(resolve(theirs.scenario))
    assert isinstance(part, LinearisationPart)
    assert np.abs(part.off_A).max() < 1e-6
    linear = json.loads(invoke("linearise", "cart_pole_mujoco", "--json").stdout)
    model = theirs.scenario.model
    np.testing.assert_allclose(linear["A"], model.A, atol=1e-6)
    np.testing.assert_allclose(linear["B"], model.B, atol=1e-6)


@needs_mujoco
def test_a_motion_that_diverges_is_not_reset(tmp_path: Path, monkeypatch: Any) -> None:
    """MuJoCo would put the state of such a motion back to 0, and the loop would go on."""
    monkeypatch.chdir(tmp_path)  # in which MuJoCo writes a log
    settings = settings_of("InvertedPendulum-v5")
    start = PlantStart(np.array([0, 0.1, 0, 1e150]), np.zeros((4, 4)), np.zeros((4, 1)), 40_000_000)
    made = settings.system(start)
    made.advance(np.zeros(1), 0, 40_000_000)
    assert np.isnan(made.x).all()


@needs_mujoco
@pytest.mark.parametrize("name", ["cart_pole_mujoco", "double_pendulum_mujoco"])
def test_a_run_is_replayed_bit_for_bit(name: str, tmp_path: Path) -> None:
    """Also if the plant is Gymnasium's own, without a model of the user's."""
    done = invoke("simulate", name, "--set", "horizon_s=1", "--runs", tmp_path, "--no-report")
    assert done.exit_code == 0, done.output
    (folder,) = (path for path in tmp_path.iterdir() if path.name != "latest")
    assert (folder / "plant").exists() == (name == "cart_pole_mujoco")  # a copy of its model
    replayed = invoke("replay", folder)
    assert replayed.exit_code == 0, replayed.output
    assert "bit" in replayed.output


def start(n: int = 2, m: int = 1, step_ns: int = 50_000_000) -> PlantStart:
    return PlantStart(np.zeros(n), np.zeros((n, n)), np.zeros((n, m)), step_ns)


def test_the_pendulum_of_gymnasium_has_the_logarithm_of_its_step() -> None:
    """ω' = ω + (15 sin θ + 3u) h and θ' = θ + ω' h, with θ = 0 upright, h = 0.05 s."""
    settings, h = GymnasiumSettings(kind="gymnasium", id="Pendulum-v1"), 0.05
    linear = linearise(lambda x0: settings.system(start()._replace(x0=x0)), 2, 1, step_ns=round(h * 1e9))
    step = np.array([[1 + 15 * h * h, h, 3 * h * h], [15 * h, 1, 3 * h], [0, 0, 1]])
    expected = logm(step) / h
    np.testing.assert_allclose(linear.A, expected[:2, :2], atol=1e-6)
    np.testing.assert_allclose(linear.B, expected[:2, 2:], atol=1e-6)
    np.testing.assert_allclose(expm(linear.A * h), step[:2, :2], atol=1e-7)
    moved = settings.system(start()._replace(x0=np.array([0.1, 0.2])))
    moved.advance(np.array([0.5]), 0, 50_000_000)
    speed = 0.2 + (15 * math.sin(0.1) + 1.5) * h
    np.testing.assert_allclose(moved.x, [0.1 + speed * h, speed], rtol=1e-12)


def test_an_environment_that_fails_stops_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    made = GymnasiumSettings(kind="gymnasium", id="Pendulum-v1").system(start())
    monkeypatch.setattr(made._environment, "step", lambda u: 1 / 0)
    with pytest.raises(SystemFailedError, match=r"Pendulum-v1.*ZeroDivisionError"):
        made.advance(np.zeros(1), 0, 50_000_000)


def test_a_gymnasium_environment_becomes_a_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = noack.new("gymnasium:Pendulum-v1", "made.toml", settings={"network.mansd": 0})
    made.save("made.toml")
    assert made.scenario.plant.rate_hz == 20.0
    run = noack.simulate("made.toml")
    assert run.ok
    assert run.replay().bit_exact

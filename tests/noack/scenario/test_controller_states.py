"""A controller with states of its own: against scipy, from files and objects, and refused settings."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import StateSpace

import noack
from noack.plants.systems.traced_equations import NotEnclosedError
from noack.scenario.resolution import loop_of, resolve
from noack.theory.certificates.plant_equations import equations_of

A, B, K = np.array([[0.0, 1.0], [0.0, -2.0]]), np.array([[0.0], [5.0]]), np.array([[-6.0, -1.2]])
INTEGRAL = {"kind": "state_space", "A": [[0.0]], "B": [[1.0, 0.0]], "C": [[-8.0]]}
LOOP = {
    "name": "servo",
    "horizon_s": 6.0,
    "model": {"A": A.tolist(), "B": B.tolist(), "gain": K.tolist(), "state_names": ["angle", "rate"]},
    "plant": {"initial_state": [0.5, 0.0]},
    "controller": INTEGRAL,
    "trigger": {"beta": 0.05, "alpha_per_s": 0.3, "floor": 0.002},
    "network": {"mansd": 3, "loss": {"model": "bernoulli", "probability": 0.5}},
}
"""A servo with the integral of its angle."""


def test_a_resolved_scenario_has_the_states_of_the_controller() -> None:
    loop = loop_of(resolve(noack.load(LOOP)))
    assert np.array_equal(loop.A, [[0, 1, 0], [0, -2, 0], [1, 0, 0]])
    assert np.array_equal(loop.K, [[-6.0, -1.2, -8.0]])
    assert loop.state_names == ("angle", "rate", "controller")
    assert [output.name for output in loop.outputs] == ["angle", "rate"]


def test_the_loop_without_losses_is_that_of_scipy() -> None:
    """With a small threshold the loop is nearly the continuous one of plant and controller."""
    settings = {"network.loss": {"model": "lossless"}, "trigger.beta": 1e-6, "trigger.floor": 1e-6}
    run = noack.simulate(noack.load(LOOP, {**settings, "controller.rate_hz": 5000, "plant.rate_hz": 5000}))

    def flow(_t: float, z: np.ndarray) -> np.ndarray:
        u = K @ z[:2] - 8.0 * z[2:]
        return np.concatenate([A @ z[:2] + B @ u, z[:1]])

    samples = run.samples()
    times = np.asarray(samples["t_s"])
    expected = solve_ivp(flow, (0, times[-1]), [0.5, 0, 0], t_eval=times, rtol=1e-9, atol=1e-12).y
    found = np.array([samples[f"x_{index}"] for index in (1, 2, 3)])
    assert np.abs(found - expected).max() < 0.01  # the input is held for 0.2 ms


def test_a_constant_load_leaves_no_error() -> None:
    disturbance = {"kind": "step", "at": "input", "amplitude": [0.3], "from_s": 0.0}
    settings = {"plant.disturbances": [disturbance], "horizon_s": 10.0}
    without = {**LOOP, "controller": {"kind": "linear"}}
    angles = [
        np.asarray(noack.simulate(noack.load(loop, settings)).samples()["x_1"])[-500:]
        for loop in (LOOP, without)
    ]
    assert np.abs(angles[0]).max() < 0.004  # about the threshold
    assert np.abs(angles[1] - 0.05).max() < 0.004  # 0.3 / 6


def test_a_plant_in_python_has_the_same_motion(tmp_path: Path) -> None:
    code = (
        "class Servo:\n    def derivative(self, t_s, x, u):\n        return x[1], -2.0 * x[1] + 5.0 * u[0]\n"
    )
    (tmp_path / "servo.py").write_text(code)
    system = {"kind": "python", "file": str(tmp_path / "servo.py"), "name": "Servo"}
    runs = [noack.simulate(noack.load(LOOP, more)) for more in ({}, {"plant.system": system})]
    found = [np.array([run.samples()[f"x_{index}"] for index in (1, 2, 3)]) for run in runs]
    assert np.abs(found[0] - found[1]).max() < 1e-4  # within a step, x is taken to change linearly
    assert runs[1].replay().bit_exact


def test_equations_that_accept_any_state_are_not_those_of_the_controller(tmp_path: Path) -> None:
    """Called with (x, ξ) they return as many rates; that of ξ is another one."""
    code = "class Any:\n    def derivative(self, t_s, z, u):\n        return -(z**3) - z + u[0]\n"
    (tmp_path / "any.py").write_text(code)
    system = {"kind": "python", "file": str(tmp_path / "any.py"), "name": "Any"}
    controller = {"kind": "state_space", "A": [[-1.0]], "B": [[1.0]], "C": [[0.5]]}
    model = {"A": [[-1.0]], "B": [[1.0]], "gain": [[-3.0]], "state_names": ["a"]}
    loop = {**LOOP, "model": model, "plant": {"initial_state": [0.3], "system": system}}
    with pytest.raises(NotEnclosedError, match="a state of the controller"):
        equations_of(resolve(noack.load({**loop, "controller": controller})))
    assert equations_of(resolve(noack.load({**loop, "controller": {"kind": "linear"}}))) is not None


def test_it_is_certified_and_replayed() -> None:
    run = noack.simulate(noack.load(LOOP))
    assert run.replay().bit_exact
    verdicts = {claim.verdict for claim in run.claims if claim.source == "certificate"}
    assert "held" in verdicts
    assert "violated" not in verdicts


def test_files_and_objects_give_the_same_controller(tmp_path: Path) -> None:
    matrices = {key: np.array(INTEGRAL[key]) for key in "ABC"} | {"D": K}
    np.savez(tmp_path / "integral.npz", allow_pickle=False, **matrices)
    by_file = {**LOOP, "controller": {"kind": "state_space", "file": str(tmp_path / "integral.npz")}}
    objects = (tuple(matrices.values()), StateSpace(*matrices.values()))
    loops = [noack.load(by_file)]
    loops += [noack.from_system((A, B), K, [0.5, 0.0], controller=given) for given in objects]
    for loop in loops:
        assert np.array_equal(loop_of(resolve(loop)).H, loop_of(resolve(noack.load(LOOP))).H)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"controller.B": [[1.0]]}, "expected 1 x 2 (one column per state of the model)"),
        ({"controller.C": [[1.0], [1.0]]}, "expected 1 x 1 (one row per input)"),
        ({"controller.D": [[1.0]]}, "expected 1 x 2 (one row per input, one column"),
        ({"controller.A": [[0.0, 1.0]]}, "the controller's matrix A is square"),
        ({"controller.A": None}, "give the matrices A, B and C"),
        ({"controller.C": [[8.0]]}, "with its states, u = K x does not stabilise"),
        ({"controller.setpoint": [1.0, 0.0]}, "state the plant in deviations from it"),
        ({"plant.measurement.noise_std": [0.1, 0.1]}, "not with controller.kind"),
        ({"observer": {"kind": "luenberger", "poles_per_s": [-8.0, -9.0]}}, "not with controller.kind"),
        ({"model.load": "input"}, "not with controller.kind"),
        ({"trigger": {"policy": "relative", "sigma": 0.1}}, '"relative" compares with x'),
        ({"controller.file": "nothing.npz", "controller.A": None}, "the file has B, and so has the scenario"),
    ],
)  # fmt: skip
def test_mistakes_get_one_line(settings: dict[str, object], message: str) -> None:
    with pytest.raises(noack.NoackError) as caught:
        noack.load(LOOP, settings)
    key = next(iter(settings))
    assert key.split(".")[0] in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_controller_in_discrete_time_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "discrete.npz", A=[[1.0]], B=[[1.0, 0.0]], C=[[-8.0]], dt=0.01)
    text = '[controller]\nkind = "state_space"\nfile = "discrete.npz"\n'
    with pytest.raises(noack.NoackError, match="in discrete time"):
        noack.load({**LOOP, **tomllib.loads(text.replace("discrete.npz", str(tmp_path / "discrete.npz")))})

"""A controller with states of its own: against scipy, from files and objects, and refused settings."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import StateSpace

import noack
from cosim.analysis.witnesses import resolved_content
from noack.plants.systems.traced_equations import NotEnclosedError
from noack.proof.elaborate.scenario import read_loop
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
OBSERVER = {"kind": "luenberger", "poles_per_s": [-28.0, -29.0]}
LOAD = {"kind": "step", "at": "input", "amplitude": [0.3], "from_s": 0.0}
PIECES = [
    {"kind": "step", "output": "angle", "value": 1.0, "from_s": 1.0, "join_s": 1.0},
    {"kind": "sine", "output": "angle", "amplitude": 0.2, "hz": 0.2, "from_s": 6.0, "join_s": 1.0},
]


def test_a_resolved_scenario_has_the_states_of_the_controller() -> None:
    loop = loop_of(resolve(noack.load(LOOP)))
    assert np.array_equal(loop.A, [[0, 1, 0], [0, -2, 0], [1, 0, 0]])
    assert np.array_equal(loop.K, [[-6.0, -1.2, -8.0]])
    assert loop.state_names == ("angle", "rate", "controller")
    assert [output.name for output in loop.outputs] == ["angle", "rate"]


def test_only_the_loop_with_the_controller_has_to_be_stable() -> None:
    """Â + B̂K is not stable, but D replaces K; u = Kx alone is another loop."""
    replaced = {"model.gain": [[6.0, 1.2]], "controller.D": K.tolist()}
    assert np.array_equal(loop_of(resolve(noack.load(LOOP, replaced))).K, [[-6.0, -1.2, -8.0]])
    with pytest.raises(noack.NoackError, match=r"model.gain = \[\[6.0, 1.2\]\]: u = K x does not stabilise"):
        noack.load({**LOOP, "controller": {}}, {"model.gain": [[6.0, 1.2]]})


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
    "settings",
    [{"controller.setpoint": [1.0, 0.0]}, {"controller.reference": PIECES}],
    ids=["set-point", "pieces"],
)
def test_it_follows_a_reference_under_a_load(settings: dict[str, object]) -> None:
    """About the reference the loop is the one that starts at x(0) − x_r(0) without it."""
    more = {"plant.disturbances": [LOAD], "horizon_s": 12.0}
    scenario = noack.load(LOOP, {**more, **settings})
    start = loop_of(resolve(scenario)).reference
    assert start is not None
    run = noack.simulate(scenario)
    samples = run.samples()
    times_ns = np.round(np.asarray(samples["t_s"]) * 1e9).astype(np.int64)
    distance = np.array([samples[f"x_{index}"] for index in (1, 2, 3)]).T - start.states(times_ns)
    assert np.abs(distance[-2500:, 0]).max() < 0.006  # about the threshold, and what a held u_r lags behind
    assert run.replay().bit_exact
    if "controller.setpoint" in settings:
        moved = (np.array([0.5, 0.0]) - start.state(0)[:2]).tolist()
        without = noack.simulate(noack.load(LOOP, {**more, "plant.initial_state": moved})).samples()
        expected = np.array([without[f"x_{index}"] for index in (1, 2, 3)]).T
        assert np.abs(distance - expected).max() < 1e-9


def test_the_reference_of_the_controllers_state_solves_its_equation() -> None:
    """ξ_r is continuous, and its slope is A_c ξ_r + B_c x_r."""
    reference = loop_of(
        resolve(noack.load(LOOP, {"controller.reference": PIECES, "horizon_s": 12.0}))
    ).reference
    assert reference is not None
    t_ns = np.arange(0, 12_000_000_000, 1_000_000)
    x_r = reference.states(t_ns)
    assert np.abs(np.diff(x_r, axis=0)).max() < 0.01
    slope = np.diff(x_r[:, 2]) / 1e-3
    assert np.abs(slope - (x_r[1:, 0] + x_r[:-1, 0]) / 2).max() < 1e-5


def test_an_observer_estimates_the_plant_and_takes_the_controllers_state_as_it_is() -> None:
    settings = {"observer": OBSERVER, "plant.measurement.C": [[1.0, 0.0]]}
    scenario = resolve(noack.load(LOOP, settings))
    assert scenario.plant.measurement.C == ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    run = noack.simulate(noack.load(LOOP, {**settings, "plant.disturbances": [LOAD], "horizon_s": 12.0}))
    assert np.abs(np.asarray(run.samples()["x_1"])[-2500:]).max() < 0.012
    assert run.replay().bit_exact


def test_the_checker_reads_it_with_an_observer_about_a_reference() -> None:
    """ξ is measured, so the observer's error has none of it."""
    settings = {"observer": OBSERVER, "plant.measurement.C": [[1.0, 0.0]], "controller.reference": PIECES}
    content = resolved_content(resolve(noack.load(LOOP, {**settings, "horizon_s": 12.0})))
    loop = read_loop(content, box=False, ideal=False)
    assert loop.fault() == ""
    assert loop.until == 12
    assert loop.observer is not None
    assert not any(entry != 0 for entry in loop.observer.last_correction.tolist()[2])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"controller.B": [[1.0]]}, "as controller.A, one column per state of the model), found 1 x 1"),
        ({"controller.B": [[1.0] * 3] * 3}, "expected 1 x 2 (as many rows as controller.A, one column"),
        ({"controller.C": [[1.0], [1.0]]}, "expected 1 x 1 (one row per input, as many columns"),
        ({"controller.D": [[1.0]]}, "expected 1 x 2 (one row per input, one column"),
        ({"controller.A": [[0.0, 1.0]]}, "the controller's matrix A is square"),
        ({"controller.A": None}, "give the matrices A, B and C"),
        ({"model.state_names": ["angle", "controller"]}, "controller occurs more than once"),
        ({"controller.C": [[8.0]]}, "with the controller's states, u = K x does not stabilise"),
        ({"plant.measurement.noise_std": [0.1, 0.1]}, "not with controller.kind"),
        ({"observer": {"kind": "kalman", "initial_std": [0.5, 0.5]}}, 'take "luenberger"'),
        ({"observer": OBSERVER, "plant.measurement.C": [[0.0, 1.0]]}, "states that plant.measurement.C does"),
        ({"changes": [{"at_s": 1.0, "set": {"controller.setpoint": [1.0, 0.0]}}]}, "give a controller.ref"),
        ({"controller.reference": [{"kind": "file", "t_s": [0, 6], "x": [[0, 0]] * 2, "u": [[0]] * 2}]},
         "a file has no states of the controller"),
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

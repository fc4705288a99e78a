"""``model.integral``: the controller that it becomes, what it does, and refused settings."""

import json
from pathlib import Path

import numpy as np
import pytest

import noack
from cosim.studies.new_loop import choose
from noack.controllers.state_space import StateSpaceSettings
from noack.scenario.integrals import augmented, require_held
from noack.scenario.resolution import loop_of, resolve
from tests.helpers.shipped import shipped

GAIN = [[-11.75, -2.5, 15.0]]
LOOP = {
    "name": "servo",
    "horizon_s": 10.0,
    "model": {
        "A": [[0.0, 1.0], [0.0, -2.0]], "B": [[0.0], [4.0]], "gain": GAIN, "integral": "angle",
        "state_names": ["angle", "speed"],
    },
    "plant": {
        "initial_state": [0.5, 0.0],
        "disturbances": [{"kind": "step", "at": "input", "amplitude": [0.3], "from_s": 0.0}],
    },
    "trigger": {"beta": 0.05, "alpha_per_s": 0.5, "floor": 0.002},
    "network": {"mansd": 3, "loss": {"model": "bernoulli", "probability": 0.5}},
}  # fmt: skip
MIXED = [{"name": "middle", "row": [0.5, 0.5]}]


@pytest.mark.parametrize(
    ("more", "row"),
    [
        ({}, [-1.0, 0.0]),
        ({"outputs": [{"name": "shaft", "row": "angle"}], "model.integral": "shaft"}, [-1.0, 0.0]),
        ({"outputs": MIXED, "model.integral": ["middle"]}, [-0.5, -0.5]),
    ],
)
def test_it_is_a_state_space_controller(more: dict[str, object], row: list[float]) -> None:
    scenario = noack.load(LOOP, more)
    controller = scenario.controller
    assert isinstance(controller, StateSpaceSettings)
    assert (((0.0,),), (tuple(row),), ((15.0,),)) == (controller.A, controller.B, controller.C)
    assert scenario.model.gain == ((-11.75, -2.5),)
    assert np.array_equal(loop_of(resolve(scenario)).K, GAIN)


def test_there_is_no_steady_state_error_under_a_load() -> None:
    plain = {"model.integral": None, "model.gain": [[-11.75, -2.5]]}
    angles = [
        np.asarray(noack.simulate(noack.load(LOOP, more)).samples()["x_1"])[-1000:] for more in ({}, plain)
    ]
    assert np.abs(angles[0]).max() < 0.003
    assert np.abs(angles[1] - 0.3 / 11.75).max() < 0.003


def test_its_margin_is_that_of_the_augmented_matrices() -> None:
    periodic = {"trigger": {"policy": "periodic", "period_s": 0.1}, "plant": {"initial_state": [0.5, 0.0]}}
    A, B = augmented(np.array([[0.0, 1.0], [0.0, -2.0]]), np.array([[0.0], [4.0]]), np.array([[1.0, 0.0]]))
    by_hand = {
        "model": {"A": A.tolist(), "B": B.tolist(), "gain": GAIN},
        "plant": {"initial_state": [0.5, 0.0, 0.0]},
    }
    margins = [noack.margin(noack.load({**LOOP, **periodic, **more}), most_mansd=3, period=False).to_json()
               for more in ({}, by_hand)]  # fmt: skip
    assert margins[0] == margins[1]
    assert margins[0]["every_mansd"] or margins[0]["stable_mansd"]


def test_a_file_with_loops_has_it_in_each() -> None:
    """One loop has its own gain, another one no integral."""
    loops = [{"name": "one"}, {"name": "two", "model": {"integral": "angle", "gain": [[-6.0, -1.2, 4.0]]}}]
    scenario = noack.load({**LOOP, "loops": loops})
    from noack.scenario.resolution import resolved_loops

    one, two = resolved_loops(scenario)
    assert np.array_equal(loop_of(one).K, GAIN)
    assert np.array_equal(loop_of(two).K, [[-6.0, -1.2, 4.0]])


def test_the_gain_has_the_poles_that_are_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = noack.gain("servo_reference", poles=[-3.0, -4.0, -5.0], integral="angle")
    assert pytest.approx(np.array(GAIN)) == result.K
    assert sorted(result.eigenvalues.real) == pytest.approx([-5.0, -4.0, -3.0])
    document = result.to_json()
    assert document["integral"] == ["angle"]
    assert 'integral = ["angle"]' in repr(result)
    (tmp_path / "gain.json").write_text(json.dumps(document))
    monkeypatch.setattr(choose, "RUN_WORK", 0.0)  # no search for proofs
    new = noack.new(tmp_path / "gain.json", tmp_path / "servo.toml")
    assert 'integral = ["angle"]' in new.text
    assert np.array_equal(loop_of(resolve(new.scenario)).K, GAIN)


def test_a_regulator_weighs_the_integral() -> None:
    slow, fast = (noack.gain("servo_reference", q=[1, 1, q], integral="angle") for q in (0.1, 10.0))
    assert fast.K[0, 2] == pytest.approx(10 * slow.K[0, 2])  # K_i is the root of q/r
    assert slow.decay_per_s < fast.decay_per_s


def test_the_gain_of_a_scenario_is_that_of_its_plant_alone() -> None:
    """Neither the controller's states nor loads are the plant's."""
    for name in ("dc_motor_load", "servo_reference"):
        assert noack.gain(name).K.shape[1] == shipped(name).model.dimensions[0]


def test_the_matrices_are_those_of_the_integral() -> None:
    A, B = augmented(np.array([[1.0]]), np.array([[2.0]]), np.array([[3.0]]))
    assert np.array_equal(A, [[1.0, 0.0], [-3.0, 0.0]])
    assert np.array_equal(B, [[2.0], [0.0]])


def test_outputs_that_cannot_be_held_together_are_named() -> None:
    A, B = np.diag([-1.0, -2.0]), np.eye(2)
    rows = {"a": np.array([1.0, 0.0]), "b": np.array([0.0, 1.0]), "sum": np.array([1.0, 1.0])}
    require_held(A, B, {name: rows[name] for name in ("a", "b")})
    with pytest.raises(ValueError, match="a and b and sum together; name fewer, at most 2 for 2 inputs"):
        require_held(A, B, rows)
    with pytest.raises(ValueError, match="a and b together; name fewer, at most 1 for 1 input"):
        require_held(A, np.array([[1.0], [1.0]]), {name: rows[name] for name in ("a", "b")})
    with pytest.raises(ValueError, match="rests at difference = 0 only"):  # its zero is at 0
        require_held(A, np.array([[1.0], [2.0]]), {"difference": np.array([1.0, -1.0])})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model.integral": "height"}, '"height": no output or state of this name; these are angle, speed'),
        ({"model.integral": "speed"}, "model.integral: the model rests at speed = 0 only, so no input can"),
        ({"model.integral": ["angle", "speed"]}, "model.integral: the model rests at speed = 0 only"),
        ({"model.gain": [[-11.75, -2.5]]}, "model.gain: 1 x 2, expected 1 x 3"),
        ({"model.gain": None}, "model.gain: missing, expected 1 x 3"),
        ({"model.gain": [[-11.75, -2.5, -15.0]]}, "model.gain: with model.integral, u = K x does not"),
        ({"model.load": "input"}, 'model.load = "input": not with controller.kind = "state_space"'),
        ({"controller.kind": "python", "controller.name": "m:C"}, "model.integral: not with controller.kind"),
        ({"model.integral": ["angle", "angle"]}, 'model.integral: "angle" occurs twice'),
        ({"model.integral": []}, "model.integral = []: give the names of outputs"),
        ({"trigger": {"policy": "relative", "sigma": 0.1}}, '"relative" compares with x'),
    ],
)  # fmt: skip
def test_mistakes_get_one_line(settings: dict[str, object], message: str) -> None:
    with pytest.raises(noack.NoackError) as caught:
        noack.load(LOOP, settings)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("speed", "integral: the model rests at speed = 0 only, so no input can steer its integral"),
        ("height", "integral height: no output or state of this name; these are angle, speed"),
    ],
)
def test_a_gain_needs_an_output_that_can_be_held(name: str, message: str) -> None:
    with pytest.raises(noack.NoackError, match=message):
        noack.gain("servo_reference", integral=name)

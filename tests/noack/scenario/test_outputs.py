"""The outputs of a scenario: rows of C with names, units and allowed errors."""

from noack.scenario.outputs import LoopOutput
from noack.scenario.resolution import loop_of, resolved_loops
from noack.scenario.scenario_file import validate
from tests.helpers.shipped import resolved, shipped

OUTPUTS = (
    'outputs=[{name="angle", unit="rad", allowed=0.02}, {name="tip", unit="m", row=[0.5, 0.1]}, '
    '{name="speed", row="rate"}]'
)
EXPECTED = (
    LoopOutput("angle", "rad", (1.0, 0.0), 0.02),
    LoopOutput("tip", "m", (0.5, 0.1)),
    LoopOutput("speed", "rad/s", (0.0, 1.0)),
)


def test_an_output_is_a_state_or_a_sum_of_states() -> None:
    scenario = resolved("unstable_pendulum", OUTPUTS)
    assert loop_of(scenario).outputs == EXPECTED
    rows = [entry["row"] for entry in scenario.content()["outputs"]]
    assert rows == [[1.0, 0.0], [0.5, 0.1], [0.0, 1.0]]


def test_without_outputs_they_are_the_states_with_the_units_of_the_plant() -> None:
    assert [output.name for output in loop_of(resolved("tabuada_dynamic")).outputs] == ["x_1", "x_2"]
    content = shipped("dc_motor").content()
    del content["outputs"]
    motor = loop_of(resolved_loops(validate(content, "here"))[0]).outputs
    assert [output.unit for output in motor] == ["rad", "rad/s", "A"]
    assert motor[1].row == (0.0, 1.0, 0.0)


def test_names_and_units_that_the_model_lacks_are_those_of_the_plants_kind() -> None:
    content = shipped("cart_pole").content()
    del content["model"]["state_names"], content["model"]["input_names"]
    content["outputs"] = [{"name": "angle_from_upright", "allowed": 0.1}]
    scenario = validate(content, "here")
    angle = LoopOutput("angle_from_upright", "rad", (0.0, 0.0, 1.0, 0.0), 0.1)
    assert scenario.loop_outputs() == (angle,)
    model = resolved_loops(scenario)[0].model
    assert model.state_names == ("position", "velocity", "angle_from_upright", "rate")
    assert model.state_units == ("m", "m/s", "rad", "rad/s")
    assert model.input_names == ("force",)


def test_units_of_states_are_those_of_their_outputs() -> None:
    units = 'model.state_units=["rad", "rad/s"]'
    assert [output.unit for output in resolved("tabuada_dynamic", units).loop_outputs()] == ["rad", "rad/s"]
    stated = resolved("unstable_pendulum", 'outputs=[{name="rate"}, {name="both", row=[1.0, 1.0]}]')
    assert [output.unit for output in loop_of(stated).outputs] == ["rad/s", ""]
    loaded = resolved("dc_motor_load", units)
    assert loaded.model.state_units == ("rad", "rad/s", "")


def test_a_loop_of_several_has_outputs_of_its_own() -> None:
    content = shipped("unstable_pendulum", OUTPUTS).content()
    content["loops"] = [{"name": "a"}, {"name": "b", "outputs": [{"name": "rate", "unit": "rad/s"}]}]
    first, second = resolved_loops(validate(content, "here"))
    assert loop_of(first).outputs == EXPECTED
    assert loop_of(second).outputs == (LoopOutput("rate", "rad/s", (0.0, 1.0)),)

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
    LoopOutput("speed", "", (0.0, 1.0)),
)


def test_an_output_is_a_state_or_a_sum_of_states() -> None:
    scenario = resolved("unstable_pendulum", OUTPUTS)
    assert loop_of(scenario).outputs == EXPECTED
    rows = [entry["row"] for entry in scenario.content()["outputs"]]
    assert rows == [[1.0, 0.0], [0.5, 0.1], [0.0, 1.0]]


def test_without_outputs_they_are_the_states_with_the_units_of_the_plant() -> None:
    assert [output.name for output in loop_of(resolved("unstable_pendulum")).outputs] == ["angle", "rate"]
    motor = loop_of(resolved("dc_motor")).outputs
    assert [output.unit for output in motor] == ["rad", "rad/s", "A"]
    assert motor[1].row == (0.0, 1.0, 0.0)


def test_a_loop_of_several_has_outputs_of_its_own() -> None:
    content = shipped("unstable_pendulum", OUTPUTS).content()
    content["loops"] = [{"name": "a"}, {"name": "b", "outputs": [{"name": "rate", "unit": "rad/s"}]}]
    first, second = resolved_loops(validate(content, "here"))
    assert loop_of(first).outputs == EXPECTED
    assert loop_of(second).outputs == (LoopOutput("rate", "rad/s", (0.0, 1.0)),)

"""Mistakes in disturbances, measurements and observers: one clear line each."""

import json
from typing import Any

import pytest

from noack.config.resolution import resolve
from noack.config.scenario_file import dumps, validate
from noack.core.errors import CallerError
from noack.protocol.wire_format import Flow

KALMAN: dict[str, Any] = {"kind": "kalman", "input_std": [0.2], "initial_std": [1.0, 1.0]}
LUENBERGER: dict[str, Any] = {"kind": "luenberger", "poles_per_s": [-5.0, -6.0]}
POSITION: dict[str, Any] = {"C": [[1.0, 0.0]], "noise_std": [0.01]}


def refusal_of(content: dict[str, Any], **changes: Any) -> str:
    content = json.loads(json.dumps(content))
    for key, value in changes.items():
        section, _, last = key.rpartition("__")
        (content[section] if section else content)[last] = value
    with pytest.raises(CallerError) as refusal:
        resolve(validate(content, "file"))
    return str(refusal.value)


@pytest.mark.parametrize(
    ("one", "line"),
    [
        ({"kind": "gaussian", "std": [1.0, 2.0]},
         "plant.disturbances.0.std = [1.0, 2.0]: expected 1 entries (at = \"input\": one per "
         "input), found 2"),
        ({"kind": "uniform", "at": "state", "bound": [1.0]},
         "plant.disturbances.0.bound = [1.0]: expected 2 entries (at = \"state\": one per state), "
         "found 1"),
        ({"kind": "gaussian", "std": [-1.0]},
         "plant.disturbances.0.std = [-1.0]: standard deviations cannot be negative"),
        ({"kind": "step", "amplitude": [1.0], "from_s": 2.0, "until_s": 1.0},
         "plant.disturbances.0.until_s = 1.0: must be later than from_s"),
        ({"kind": "sine", "amplitude": [1.0]}, "plant.disturbances.0.hz: missing"),
        ({"kind": "sin", "amplitude": [1.0]}, "plant.disturbances.0.kind = \"sin\": must be one of "
         "gaussian, sine, step, uniform; did you mean sine?"),
        ({"kind": "sine", "amplitude": [1.0], "hz": 1.0, "at": "output"},
         "plant.disturbances.0.at = \"output\": should be 'input' or 'state'"),
        ({"kind": "uniform", "std": [1.0]}, "plant.disturbances.0.std = [1.0]: unknown key"),
    ],
)  # fmt: skip
def test_a_mistake_in_disturbances_gets_one_line(
    content: dict[str, Any], one: dict[str, Any], line: str
) -> None:
    message = refusal_of(content, plant__disturbances=[one])
    assert message.startswith(f"file: {line}") or f"\nfile: {line}" in message, message


def test_a_state_disturbance_needs_a_linear_plant(content: dict[str, Any]) -> None:
    content["model"] = {
        "A": [[0.0] * 4] * 4, "B": [[0.0]] * 4, "gain": [[0.0] * 4], "allow_unstable": True,
    }  # fmt: skip
    content["plant"] = {
        "system": {"kind": "cart_pole"}, "initial_state": [0.0] * 4,
        "disturbances": [{"kind": "uniform", "at": "state", "bound": [1.0] * 4}],
    }  # fmt: skip
    assert refusal_of(content) == (
        'file: plant.disturbances.0.at = "state": "state" needs a linear plant; '
        'this one can be disturbed at "input"'
    )


@pytest.mark.parametrize(
    ("measurement", "observer", "line"),
    [
        ({"C": [[1.0, 0.0]]}, None,
         "plant.measurement.C = [[1.0, 0.0]]: without an [observer] the sensor has to measure "
         "every state; give an [observer], or no C"),
        ({"C": [[1.0]]}, KALMAN,
         "plant.measurement.C = [[1.0]]: expected 1 x 2 (the model has 2 states and 1 inputs; "
         "one row per output), found 1 x 1"),
        ({"noise_std": [0.1]}, None,
         "plant.measurement.noise_std = [0.1]: expected 2 entries (one per measured output), "
         "found 1"),
        ({"noise_bound": [0.1, -0.1]}, None,
         "plant.measurement.noise_bound = [0.1, -0.1]: bounds cannot be negative"),
        ({"noise_std": [0.1, 1e200]}, None,
         "plant.measurement.noise_std = [0.1, 1e+200]: standard deviations can be 1e+100 at most"),
        (POSITION, {"kind": "luenberger"}, "observer.gain: give either gain or poles_per_s"),
        (POSITION, {"kind": "luenberger", "gain": [[1.0, 0.0]]},
         "observer.gain = [[1.0, 0.0]]: expected 2 x 1 (one row per state, a column per output), "
         "found 1 x 2"),
        (POSITION, {"kind": "luenberger", "poles_per_s": [-5.0]},
         "observer.poles_per_s = [-5.0]: expected 2 poles (one per state, a pair counts twice), "
         "found 1"),
        (POSITION, {"kind": "luenberger", "poles_per_s": [-5.0, 1.0]},
         "observer.poles_per_s = [-5.0, 1.0]: need negative real parts, else the error grows"),
        (POSITION, {"kind": "luenberger", "poles_per_s": [[-5.0, -1.0]]},
         "observer.poles_per_s = [[-5.0, -1.0]]: a pair [re, im] needs im > 0; write a real pole "
         "as a number"),
        (POSITION, {"kind": "luenberger", "poles_per_s": [[-5.0, 1.0, 2.0]]},
         "observer.poles_per_s = [[-5.0, 1.0, 2.0]]: each is a number, or a pair [re, im]"),
        (POSITION, {"kind": "luenberger", "poles_per_s": [-5.0, -5.0]},
         "observer.poles_per_s: cannot be placed: "),
        ({"C": [[0.0, 1.0]]}, LUENBERGER, "plant.measurement.C: the model's mode e^(0"),
        (POSITION, {"kind": "kalman", "input_std": [0.1]},
         "observer.initial_std: missing (standard deviation of x − x̂ before the first measurement"),
        (POSITION, KALMAN | {"initial_std": [1.0]},
         "observer.initial_std = [1.0]: expected 2 entries (one per state), found 1"),
        (POSITION, KALMAN | {"Q": [[1.0, 0.0], [0.0, 1.0]]},
         "observer.Q = [[1.0, 0.0], [0.0, 1.0]]: give either Q or input_std"),
        (POSITION, KALMAN | {"R": [[0.0]]}, "observer.R = [[0.0]]: must be positive definite"),
        (POSITION, {"kind": "kalman", "initial_std": [1.0, 1.0], "Q": [[1.0, 2.0], [2.0, 1.0]]},
         "observer.Q = [[1.0, 2.0], [2.0, 1.0]]: must be positive semidefinite"),
        (POSITION, {"kind": "kalman", "initial_std": [1.0, 1.0], "Q": [[1.0, 2.0], [0.0, 1.0]]},
         "observer.Q = [[1.0, 2.0], [0.0, 1.0]]: must be symmetric"),
        ({"C": [[1.0, 0.0]]}, KALMAN,
         "observer.noise_std: the filter needs a noise above 0 on every output; give noise_std "
         "or R, or plant.measurement's noise"),
        (POSITION, {"kind": "kalman", "initial_std": [1.0, 1.0]},
         "observer.process_std: without process noise the Kalman gain tends to 0; give "
         "process_std, input_std or Q, or random disturbances of the plant"),
        (POSITION, {"kind": "luenburger", "gain": [[1.0], [1.0]]},
         'observer.kind = "luenburger": must be one of kalman, luenberger; '
         "did you mean luenberger?"),
    ],
)  # fmt: skip
def test_a_mistake_in_measurements_or_observers_gets_one_line(
    content: dict[str, Any], measurement: Any, observer: Any, line: str
) -> None:
    changes = {"plant__measurement": measurement}
    message = refusal_of(content, **changes, **({"observer": observer} if observer else {}))
    assert message.startswith((f"file: {line}", line)), message
    assert "\n" not in message


def test_measurements_too_long_for_a_datagram_are_refused(content: dict[str, Any]) -> None:
    changes: dict[str, Any] = {"plant__measurement": POSITION, "plant__measure_every": 64}
    assert refusal_of(content, **changes, observer=KALMAN) == (
        "file: plant.measure_every = 64: with an observer a measurement carries y and the inputs "
        "of 64 steps, 1 + 64 numbers; at most 64 fit"
    )


def test_every_flow_has_its_vector_length(content: dict[str, Any]) -> None:
    content["plant"] |= {"measurement": POSITION, "measure_every": 3}
    scenario = validate(content | {"observer": KALMAN}, "file")
    lengths = [scenario.message_sizes.entries(flow) for flow in Flow]
    assert lengths == [1 + 3, 2, 1, 0]  # y and three inputs; x̂; u; empty


def test_a_resolved_scenario_has_its_gain_and_resolves_to_itself(content: dict[str, Any]) -> None:
    content["plant"]["measurement"] = POSITION
    content["observer"] = {"kind": "luenberger", "poles_per_s": [[-5.0, 1.0]]}
    once = resolve(validate(content, "file"))
    assert once.observer is not None
    assert once.observer.kind == "luenberger"
    assert once.observer.gain is not None
    import tomllib

    again = validate(tomllib.loads(dumps(once)), "again")
    assert again == once == resolve(again)

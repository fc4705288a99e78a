"""The sensor's events and its observers; cosim/simulation/test_whole_loop.py has whole runs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from noack.core.core_library import core, ffi
from noack.observers.observer_settings import observer_gain, unobservable_mode
from noack.protocol.record_tables import SENSOR_MEASUREMENT, tables
from noack.protocol.roles import Output, Record
from noack.protocol.wire_format import Encoder, Flow, Message, Wire
from noack.scenario.resolution import assumed_model, resolve, steady_state, true_model
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from sensor_node.sensor import Sensor
from tests.helpers.example_rules import decaying_rule
from tests.helpers.machine_parts import machine, sensor_of

GRID_NS = 10_000_000
ZOH = np.zeros((1, 1))


def measurement(sequence: int, t_ns: int, x: Sequence[float] | np.ndarray) -> Message:
    return Message(Flow.MEASUREMENT, sequence, t_ns, np.asarray(x, dtype=float))


def updates(outputs: Sequence[Output]) -> list[Message]:
    return [output for output in outputs if isinstance(output, Message)]


def rows(outputs: Sequence[Output], n: int) -> Any:
    found = [output.row for output in outputs if isinstance(output, Record)]
    return np.array(found, tables(n, 1)[SENSOR_MEASUREMENT])


def test_an_error_equal_to_the_threshold_is_no_event() -> None:
    beta = 0.1
    for x, events in ((beta, 0), (math.nextafter(beta, 1), 1)):
        sensor = machine(Sensor(ZOH, decaying_rule(beta, 1.0, n=1), np.array([0.0])))
        assert len(updates(sensor.handle(measurement(0, 0, [x]), 0))) == events


def test_the_reading_time_of_a_datagram_does_not_matter() -> None:
    """Read on time or up to seconds late, the datagrams give the same results, bit for bit."""
    rng = np.random.default_rng(0)
    lateness_ns = np.sort(rng.integers(0, 5 * 10**9, 200))
    runs = []
    for late_ns in (np.zeros(200, int), lateness_ns):
        sensor, outputs = machine(Sensor(np.array([[-0.4]]), decaying_rule(0.2, 0.5, n=1))), []
        for k in range(200):
            message = measurement(k, k * GRID_NS, [math.sin(3 * k * GRID_NS * 1e-9)])
            outputs += sensor.handle(message, k * GRID_NS + int(late_ns[k]))
        record = rows(outputs, 1)
        assert (record["now_ns"] == record["t_ns"] + late_ns).all()
        record["now_ns"] = 0
        sent = [(m.sequence, m.t_ns, m.vector.tobytes()) for m in updates(outputs)]
        assert len(sent) > 10
        runs.append((record.tobytes(), sent))
    assert runs[0] == runs[1]


@pytest.fixture
def observed(content: dict[str, Any]) -> dict[str, Any]:
    """The double integrator with a noisy position measurement."""
    content["plant"] |= {"rate_hz": 100.0, "measurement": {"C": [[1.0, 0.0]], "noise_std": [0.01]}}
    content["controller"] = {"rate_hz": 100.0}
    content["observer"] = {
        "kind": "kalman", "input_std": [0.2], "initial_std": [1.0, 1.0],
    }  # fmt: skip
    return content


def resolved(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, "test"))


def test_complex_poles_and_several_outputs_are_placed() -> None:
    Ad = expm(np.array([[0.0, 1, 0], [0, 0, 1], [1, -2, 0.5]]) * 0.01)
    wanted = (np.exp((-3 + 4j) * 0.01), np.exp((-3 - 4j) * 0.01), np.exp(-9 * 0.01 + 0j))
    for outputs in (np.eye(3)[:1], np.eye(3)[[0, 2]], np.eye(3)):
        L = observer_gain(Ad, outputs, wanted)
        found = np.linalg.eigvals((np.eye(3) - L @ outputs) @ Ad)
        np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(wanted), atol=1e-7)


def test_an_unobservable_mode_is_reported_by_its_eigenvalue() -> None:
    Ad = np.diag([1.5, 0.5, 0.9])
    assert unobservable_mode(Ad, np.array([[1.0, 0.0, 0.0]])) is None
    assert unobservable_mode(Ad, np.array([[0.0, 1.0, 1.0]])) == 1.5
    assert unobservable_mode(Ad, np.array([[1.0, 1.0, 0.0]]), stable_too=True) == 0.9


def test_filter_settings_default_to_the_scenarios_noise_and_disturbances(
    observed: dict[str, Any],
) -> None:
    observed["plant"]["disturbances"] = [
        {"kind": "gaussian", "at": "input", "std": [0.3]},
        {"kind": "uniform", "at": "state", "bound": [0.0, 0.6]},
        {"kind": "sine", "amplitude": [5.0], "hz": 1.0},
    ]
    del observed["observer"]["input_std"]
    scenario = resolved(observed)
    believed, h = assumed_model(scenario), 0.01
    into = np.array([h**2 / 2, h])  # of the double integrator with a held input
    expected = (0.3**2 + 0.6**2 / 3) * np.outer(into, into)
    np.testing.assert_allclose(believed.Q, expected, rtol=1e-9)
    assert believed.R.tolist() == [[0.01**2]]
    observed["observer"] |= {"process_std": [0.0, 0.0], "input_std": [1.0], "noise_std": [0.5]}
    told = assumed_model(resolved(observed))
    np.testing.assert_allclose(told.Q, np.outer(into, into), rtol=1e-9)
    assert told.R.tolist() == [[0.25]]
    np.testing.assert_allclose(true_model(resolved(observed)).Q, expected, rtol=1e-9)


def test_the_scalar_steady_state_solves_the_quadratic_equation(content: dict[str, Any]) -> None:
    """P⁻ = a²P⁻R/(P⁻ + R) + q, solved by hand."""
    a, h, r, q = 2.0, 0.01, 0.04, 9e-4
    content["model"] = {"A": [[a]], "B": [[1.0]], "gain": [[-3.0]]}
    content["plant"] = {
        "initial_state": [0.0], "rate_hz": 100.0,
        "measurement": {"noise_std": [0.2]},
    }  # fmt: skip
    content["observer"] = {"kind": "kalman", "Q": [[q]], "initial_std": [1.0]}
    content["plant"]["disturbances"] = [
        {"kind": "gaussian", "at": "state", "std": [np.sqrt(q) * a / np.expm1(a * h)]}
    ]
    f = np.exp(2 * a * h)
    b = r * (1 - f) - q
    before = (-b + np.sqrt(b**2 + 4 * q * r)) / 2
    found = steady_state(resolved(content))
    assert found.covariance[0, 0] == pytest.approx(before * r / (before + r), rel=1e-9)
    assert found.gain[0, 0] == pytest.approx(before / (before + r), rel=1e-9)
    assert found.radius == pytest.approx(np.exp(a * h) * r / (before + r), rel=1e-9)


def test_a_measurement_after_the_runs_end_is_rejected(observed: dict[str, Any]) -> None:
    """An authentic one of any time cannot keep the observer busy with the steps up to it."""
    scenario = resolved(observed)
    own, horizon_ns = sensor_of(scenario), scenario.timing.horizon_ns
    wire, encoder = Wire(1, bytes(32)), Encoder(1, bytes(32))
    reception, message = own.machines[0].machine.received, ffi.new("noack_message *")
    values = np.zeros(reception.entries)
    for t_ns, expected in (
        (horizon_ns, core.NOACK_ACCEPTED), (horizon_ns + 1, core.NOACK_BAD_RANGE),
        (10**15, core.NOACK_BAD_RANGE),
    ):  # fmt: skip
        datagram = encoder.encode(Message(Flow.MEASUREMENT, 1, t_ns, values))
        found = core.noack_wire_examine(
            wire.core, ffi.addressof(reception), 0, datagram, len(datagram), True, False, message
        )
        assert found == expected

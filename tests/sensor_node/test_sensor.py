"""The sensor's events and what it rejects.

Whole runs are compared with a reference loop in tests/cosim/simulation/test_whole_loop.py: with
acknowledgements, set points and their changes, and every trigger policy.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from noack.core.core_library import core, ffi
from noack.protocol.record_tables import SENSOR_MEASUREMENT, tables
from noack.protocol.roles import Output, Record
from noack.protocol.wire_format import Encoder, Flow, Message, Wire
from noack.scenario.resolution import resolve
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
    records = [output.row for output in outputs if isinstance(output, Record)]
    return np.array(records, tables(n, 1)[SENSOR_MEASUREMENT])


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


def test_a_measurement_after_the_runs_end_is_rejected(content: dict[str, Any]) -> None:
    """An authentic one of any time cannot keep the observer busy with the steps up to it."""
    content["plant"]["measurement"] = {"C": [[1.0, 0.0]], "noise_std": [0.01]}
    content["observer"] = {"kind": "kalman", "input_std": [0.2], "initial_std": [1.0, 1.0]}
    scenario = resolve(validate(content, "test"))
    own, horizon_ns = sensor_of(scenario), scenario.timing.horizon_ns
    wire, encoder = Wire(1, bytes(32)), Encoder(1, bytes(32))
    reception, message = own.machines[0].machine.received, ffi.new("noack_message *")
    values = np.zeros(reception.entries)
    for t_ns, expected in (
        (horizon_ns, core.NOACK_ACCEPTED), (horizon_ns + 1, core.NOACK_BAD_RANGE),
        (10**15, core.NOACK_BAD_RANGE),
    ):  # fmt: skip
        datagram = encoder.encode(Message(Flow.MEASUREMENT, 1, t_ns, values))
        result = core.noack_wire_examine(
            wire.core, ffi.addressof(reception), 0, datagram, len(datagram), True, False, message
        )
        assert result == expected

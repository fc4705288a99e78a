"""The sensor's events, checked by hand; also with acknowledgements."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from noack.protocol.machine_interface import Output, Record
from noack.protocol.record_tables import SENSOR_MEASUREMENT, tables
from noack.protocol.wire_format import Flow, Message
from sensor_node.sensor import Sensor
from tests.machine_parts import OneLoop, machine, state_of
from tests.trigger_rules import absolute_rule, decaying_rule
from tests.wire_decoder import NO_VECTOR

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


H = np.array([[0.0, 1.0], [-2.0, -3.0]])
ALWAYS = absolute_rule(1e-9)


def split(outputs: Sequence[Output]) -> tuple[list[Message], Any]:
    sent = [output for output in outputs if isinstance(output, Message)]
    (record,) = (output for output in outputs if isinstance(output, Record))
    return sent, np.array([record.row], tables(2, 1, acknowledged=True)[record.table])[0]


def waiting(timeout_ns: int = 3 * GRID_NS, x0: Sequence[float] | None = None) -> OneLoop:
    known = None if x0 is None else np.asarray(x0, dtype=float)
    return machine(Sensor(H, ALWAYS, known, timeout_ns=timeout_ns, period_ns=GRID_NS))


def test_an_acknowledgement_of_an_unsent_update_changes_nothing() -> None:
    one = waiting(x0=[1.0, 1.0])
    before = state_of(one, "x_s")
    _, row = split(one.handle(Message(Flow.ACKNOWLEDGEMENT, 7, 0, NO_VECTOR), 5))
    assert row["x_s"].tobytes() == row["x_s_before"].tobytes() == before.tobytes()

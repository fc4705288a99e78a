"""The sensor's events, checked by hand; also with acknowledgements."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, transition
from noack.protocol.machine_interface import Output, Record
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT, tables
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


@st.composite
def measured_runs(draw: st.DrawFn) -> tuple[Matrix, Matrix | None, list[tuple[int, np.ndarray]]]:
    n = draw(st.integers(1, 4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    H = rng.uniform(-1, 1, (n, n)) * draw(st.sampled_from([0.0, 1.0]))
    # Diagonally dominant, hence invertible.
    W = 3 * np.eye(n) + rng.uniform(-0.5, 0.5, (n, n)) if draw(st.booleans()) else None
    gaps = draw(st.lists(st.integers(1, 5), min_size=1, max_size=30))  # measurements may be missing
    x, t_ns, run = rng.uniform(-1, 1, n), draw(st.integers(0, 5)) * GRID_NS, []
    for gap in gaps:
        run.append((t_ns, x))
        x = x + rng.normal(0, 0.05, n)
        t_ns += gap * GRID_NS
    return H, W, run


@given(measured_runs(), st.booleans(), st.sampled_from([0.0, 0.18]))
def test_an_event_is_exactly_where_the_error_exceeds_the_threshold(
    system: tuple[Matrix, Matrix | None, list[tuple[int, np.ndarray]]], known: bool, floor: float
) -> None:
    H, W, run = system
    x0 = run[0][1] + 0.02
    sensor = machine(Sensor(H, decaying_rule(0.2, 0.5, floor, W, len(H)), x0 if known else None))
    reset_ns, reset = (0, x0) if known else (0, None)
    for k, (t_ns, x) in enumerate(run):
        outputs = sensor.handle(measurement(k, t_ns, x), t_ns)
        (row,), sent = rows(outputs, len(x)), updates(outputs)
        # x_s from the last event in one step, not measurement by measurement.
        x_s = x if reset is None else expm(H * (t_ns - reset_ns) * 1e-9) @ reset
        e_s = x_s - x if W is None else W @ (x_s - x)
        error = float(np.linalg.norm(e_s))
        threshold = max(0.2 * math.exp(-0.5 * t_ns * 1e-9), floor)
        # Thirty propagations, each with an error of about 1e-15, amplified by ‖e^{Ht}‖ < e^{4 ·
        # 1.5}.
        np.testing.assert_allclose(row["x_s"], x_s, atol=1e-11)
        assert row["e_s_norm"] == pytest.approx(error, abs=1e-10)
        assert row["threshold"] == pytest.approx(threshold, rel=1e-14)
        if abs(error - threshold) > 1e-9:
            assert bool(sent) == (reset is None or error > threshold)
        assert (row["event"] != NO_SEQUENCE) == bool(sent)
        if sent:  # whether or not the packet arrives
            assert state_of(sensor, "x_s").tolist() == x.tolist()
            reset_ns, reset = t_ns, x


def test_an_update_carries_the_measured_state_and_its_time() -> None:
    sensor = machine(Sensor(np.zeros((2, 2)), decaying_rule(0.1, 1.0)))
    outputs: list[Output] = []
    for k, x in enumerate([[1.0, 2.0], [1.0, 2.05], [3.0, 2.0], [3.0, 7.0]]):
        outputs += sensor.handle(measurement(10 + k, k * GRID_NS, x), k * GRID_NS + 777)
    sent = updates(outputs)
    assert [(m.flow, m.sequence, m.t_ns, m.vector.tolist()) for m in sent] == [
        (Flow.UPDATE, 0, 0, [1.0, 2.0]),
        (Flow.UPDATE, 1, 2 * GRID_NS, [3.0, 2.0]),
        (Flow.UPDATE, 2, 3 * GRID_NS, [3.0, 7.0]),
    ]
    record = rows(outputs, 2)
    assert record["event"].tolist() == [0, NO_SEQUENCE, 1, 2]
    assert record["input"].tolist() == [0, 1, 2, 3]
    assert record["sequence"].tolist() == [10, 11, 12, 13]
    assert record["now_ns"].tolist() == [k * GRID_NS + 777 for k in range(4)]
    # Before the reset, so that the record contains e_s(t_k⁻).
    assert record["x_s"].tolist() == [[1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [3.0, 2.0]]


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


def test_the_sensor_acts_on_measurements_only() -> None:
    sensor = machine(Sensor(ZOH, decaying_rule(0.5, 0.25, n=1)))
    sensor.handle(measurement(0, 0, [1.0]), 0)
    assert sensor.next_deadline_ns() is None
    assert not sensor.on_timer(10**9)


MS = 1_000_000
H = np.array([[0.0, 1.0], [-2.0, -3.0]])
ALWAYS = absolute_rule(1e-9)


def acknowledgement(of: Message) -> Message:
    return Message(Flow.ACKNOWLEDGEMENT, of.sequence, of.t_ns, NO_VECTOR)


def split(outputs: Sequence[Output]) -> tuple[list[Message], Any]:
    sent = [output for output in outputs if isinstance(output, Message)]
    (record,) = (output for output in outputs if isinstance(output, Record))
    return sent, np.array([record.row], tables(2, 1, acknowledged=True)[record.table])[0]


def waiting(timeout_ns: int = 3 * GRID_NS, x0: Sequence[float] | None = None) -> OneLoop:
    known = None if x0 is None else np.asarray(x0, dtype=float)
    return machine(Sensor(H, ALWAYS, known, timeout_ns=timeout_ns, period_ns=GRID_NS))


@pytest.mark.parametrize("periods", [1, 2, 5])
def test_without_an_acknowledgement_it_transmits_the_current_state_after_the_timeout(
    periods: int,
) -> None:
    one = waiting(periods * GRID_NS, x0=[0.0, 0.0])
    sent = []
    for k in range(1, 21):
        sent += split(one.handle(measurement(k, k * GRID_NS, [float(k), 0.0]), k * GRID_NS))[0]
    assert [message.t_ns // GRID_NS for message in sent] == list(range(1, 21, periods))
    assert [message.vector[0] for message in sent] == [message.t_ns // GRID_NS for message in sent]
    assert [message.sequence for message in sent] == list(range(len(sent)))


def test_an_older_acknowledgement_leaves_it_waiting_for_the_newer() -> None:
    one = waiting(GRID_NS, x0=[0.0, 0.0])
    (first,), _ = split(one.handle(measurement(1, GRID_NS, [1.0, 0.0]), 0))
    (second,), _ = split(one.handle(measurement(2, 2 * GRID_NS, [2.0, 0.0]), 0))
    one.handle(acknowledgement(first), 2 * GRID_NS)
    np.testing.assert_allclose(
        state_of(one, "x_s"), transition(H, GRID_NS) @ [1.0, 0.0], rtol=1e-14
    )
    late = Message(Flow.MEASUREMENT, 3, 2 * GRID_NS + 1, np.array([9.0, 0.0]))
    assert split(one.handle(late, 2 * GRID_NS + 1))[0] == []
    one.handle(acknowledgement(second), 2 * GRID_NS + 2)
    np.testing.assert_allclose(state_of(one, "x_s"), transition(H, 1) @ [2.0, 0.0], rtol=1e-14)


def test_an_acknowledgement_of_an_unsent_update_changes_nothing() -> None:
    one = waiting(x0=[1.0, 1.0])
    before = state_of(one, "x_s")
    _, row = split(one.handle(Message(Flow.ACKNOWLEDGEMENT, 7, 0, NO_VECTOR), 5))
    assert row["x_s"].tobytes() == row["x_s_before"].tobytes() == before.tobytes()

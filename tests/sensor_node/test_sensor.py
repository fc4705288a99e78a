import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.config.resolution import resolve
from noack.config.scenario_file import validate
from noack.core.linear_systems import Matrix
from noack.protocol.machine_interface import Output, Record
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT, tables
from noack.protocol.wire_format import Flow, Message
from sensor_node.sensor import Sensor
from tests.machine_parts import OneLoop, machine, sensor_of, state_of
from tests.trigger_rules import decaying_rule

GRID_NS = 10_000_000
ZOH = np.zeros((1, 1))


def measurement(sequence: int, t_ns: int, x: Sequence[float] | np.ndarray) -> Message:
    return Message(Flow.MEASUREMENT, sequence, t_ns, np.asarray(x, dtype=float))


def updates(outputs: Sequence[Output]) -> list[Message]:
    return [output for output in outputs if isinstance(output, Message)]


def rows(outputs: Sequence[Output], n: int) -> Any:
    found = [output.row for output in outputs if isinstance(output, Record)]
    return np.array(found, tables(n, 1)[SENSOR_MEASUREMENT])


def feed(sensor: OneLoop, x: Callable[[float], float], until_s: float) -> list[Output]:
    """Measure the scalar x(t) on the grid."""
    outputs: list[Output] = []
    for k in range(round(until_s * 1e9) // GRID_NS + 1):
        outputs += sensor.handle(measurement(k, k * GRID_NS, [x(k * GRID_NS * 1e-9)]), k * GRID_NS)
    return outputs


def next_on_grid_ns(t_s: float) -> int:
    """The first grid time after ``t_s``."""
    return (math.floor(t_s * 1e9 / GRID_NS) + 1) * GRID_NS


def test_a_scalar_under_a_hold_has_closed_form_events() -> None:
    """H = 0, x = x₀e^{−t}, α = 1: |x(t_i) − x(t)| > βe^{−t} from t_i + ln(1 + β/x₀) on."""
    x0, beta = 2.0, 0.3
    sensor = machine(Sensor(ZOH, decaying_rule(beta, 1.0, n=1), np.array([x0])))
    sent = updates(feed(sensor, lambda t: x0 * math.exp(-t), 3.0))
    expected = [next_on_grid_ns(math.log(1 + beta / x0))]
    while expected[-1] <= 3_000_000_000:
        expected.append(next_on_grid_ns(expected[-1] * 1e-9 + math.log(1 + beta / x0)))
    assert [message.t_ns for message in sent] == expected[:-1]
    assert len(sent) == 21  # 0.14 s apart


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


@pytest.mark.parametrize("mode", ["model", "zoh"])
def test_the_sensor_of_a_scenario_uses_the_model_not_the_plant(
    content: dict[str, Any], mode: str
) -> None:
    content |= {"mode": mode}
    content["plant"] |= {"draw": "given", "A": [[9.0, 9.0], [9.0, 9.0]], "B": [[9.0], [9.0]]}
    content["network"]["initial_sync"] = "known_state"
    content["trigger"] = {"beta": 1.0, "alpha_per_s": 0.5, "weight": [[2.0, 0.0], [0.0, 1.0]]}
    sensor = sensor_of(resolve(validate(content, "here")))
    (row,) = rows(sensor.handle(measurement(0, 10**9, [0.0, 0.0]), 10**9), 2)
    # ẍ = u with u = −x − 1.5 ẋ from (1, 0), by hand for the closed loop, or constant under a hold.
    w = math.sqrt(1 - 0.75**2)
    modelled = [
        math.exp(-0.75) * (math.cos(w) + 0.75 / w * math.sin(w)),
        -math.exp(-0.75) / w * math.sin(w),
    ]
    expected = np.array(modelled if mode == "model" else [1.0, 0.0])
    np.testing.assert_allclose(row["x_s"], expected, rtol=1e-12)
    assert row["e_s_norm"] == pytest.approx(math.hypot(2 * expected[0], expected[1]), rel=1e-12)
    assert row["threshold"] == pytest.approx(math.exp(-0.5), rel=1e-14)


def test_a_scenario_without_a_known_start_transmits_at_once(content: dict[str, Any]) -> None:
    sensor = sensor_of(resolve(validate(content, "here")))
    assert not sensor.machines[0].knows_state
    assert len(updates(sensor.handle(measurement(0, 0, [1.0, 0.0]), 0))) == 1

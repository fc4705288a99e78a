"""The sensor of the acknowledgement baseline, checked by hand."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from noack.core.linear_systems import transition
from noack.protocol.machine_interface import Output, Record
from noack.protocol.record_tables import tables
from noack.protocol.wire_format import Flow, Message
from sensor_node.sensor import Sensor
from tests.machine_parts import OneLoop, machine, state_of
from tests.trigger_rules import absolute_rule, decaying_rule
from tests.wire_decoder import NO_VECTOR

MS = 1_000_000
GRID_NS = 10 * MS
H = np.array([[0.0, 1.0], [-2.0, -3.0]])
ALWAYS = absolute_rule(1e-9)


def measurement(k: int, x: Sequence[float]) -> Message:
    return Message(Flow.MEASUREMENT, k, k * GRID_NS, np.asarray(x, dtype=float))


def acknowledgement(of: Message) -> Message:
    return Message(Flow.ACKNOWLEDGEMENT, of.sequence, of.t_ns, NO_VECTOR)


def split(outputs: Sequence[Output]) -> tuple[list[Message], Any]:
    sent = [output for output in outputs if isinstance(output, Message)]
    (record,) = (output for output in outputs if isinstance(output, Record))
    return sent, np.array([record.row], tables(2, 1, acknowledged=True)[record.table])[0]


def sensor(timeout_ns: int = 3 * GRID_NS, x0: Sequence[float] | None = None) -> OneLoop:
    known = None if x0 is None else np.asarray(x0, dtype=float)
    return machine(Sensor(H, ALWAYS, known, timeout_ns=timeout_ns, period_ns=GRID_NS))


def test_the_acknowledgement_resets_the_error_and_the_event_does_not() -> None:
    one = sensor(x0=[1.0, 0.0])
    (update,), row = split(one.handle(measurement(1, [2.0, 0.5]), GRID_NS))
    before = transition(H, GRID_NS) @ [1.0, 0.0]
    np.testing.assert_allclose(row["x_s"], before, rtol=1e-14)
    assert (row["event"], update.flow, update.sequence, update.t_ns) == (0, Flow.UPDATE, 0, GRID_NS)
    sent, row = split(one.handle(measurement(2, [2.0, 0.5]), 2 * GRID_NS))
    assert sent == []  # the rule is met, but the sensor is waiting
    assert row["compared"] > row["threshold"]
    np.testing.assert_allclose(row["x_s"], transition(H, 2 * GRID_NS) @ [1.0, 0.0], rtol=1e-13)
    sent, row = split(one.handle(acknowledgement(update), 2 * GRID_NS + 5 * MS))
    assert sent == []
    assert (row["sequence"], row["t_ns"], row["model_t_ns"]) == (0, GRID_NS, 2 * GRID_NS)
    np.testing.assert_allclose(row["x_s"], transition(H, GRID_NS) @ [2.0, 0.5], rtol=1e-14)
    np.testing.assert_allclose(
        row["x_s_before"], transition(H, 2 * GRID_NS) @ [1.0, 0.0], rtol=1e-13
    )
    (update,), row = split(one.handle(measurement(3, [3.0, 0.0]), 3 * GRID_NS))  # no longer waiting
    np.testing.assert_allclose(row["x_s"], transition(H, 2 * GRID_NS) @ [2.0, 0.5], rtol=1e-13)
    assert update.sequence == 1


@pytest.mark.parametrize("periods", [1, 2, 5])
def test_without_an_acknowledgement_it_transmits_the_current_state_after_the_timeout(
    periods: int,
) -> None:
    one = sensor(periods * GRID_NS, x0=[0.0, 0.0])
    sent = []
    for k in range(1, 21):
        sent += split(one.handle(measurement(k, [float(k), 0.0]), k * GRID_NS))[0]
    assert [message.t_ns // GRID_NS for message in sent] == list(range(1, 21, periods))
    assert [message.vector[0] for message in sent] == [message.t_ns // GRID_NS for message in sent]
    assert [message.sequence for message in sent] == list(range(len(sent)))


def test_it_does_not_retransmit_if_the_rule_is_no_longer_met() -> None:
    policy, timeout_ns = decaying_rule(1.0, 1e-9), 2 * GRID_NS
    one = machine(Sensor(np.zeros((2, 2)), policy, np.zeros(2), timeout_ns=timeout_ns))
    assert split(one.handle(measurement(1, [2.0, 0.0]), 0))[0]
    assert split(one.handle(measurement(3, [0.5, 0.0]), 0))[0] == []
    assert split(one.handle(measurement(4, [2.0, 0.0]), 0))[0]


def test_the_first_measurement_is_an_event_and_x_s_is_zero_as_x_c_is() -> None:
    one = sensor()
    (update,), row = split(one.handle(measurement(0, [1.0, 2.0]), 0))
    assert row["x_s"].tolist() == [0.0, 0.0]
    assert (row["event"], row["e_s_norm"]) == (0, pytest.approx(5**0.5))
    one.handle(acknowledgement(update), 0)
    assert state_of(one, "x_s").tolist() == [1.0, 2.0]


def test_an_older_acknowledgement_leaves_it_waiting_for_the_newer() -> None:
    one = sensor(GRID_NS, x0=[0.0, 0.0])
    (first,), _ = split(one.handle(measurement(1, [1.0, 0.0]), 0))
    (second,), _ = split(one.handle(measurement(2, [2.0, 0.0]), 0))
    one.handle(acknowledgement(first), 2 * GRID_NS)
    np.testing.assert_allclose(
        state_of(one, "x_s"), transition(H, GRID_NS) @ [1.0, 0.0], rtol=1e-14
    )
    late = Message(Flow.MEASUREMENT, 3, 2 * GRID_NS + 1, np.array([9.0, 0.0]))
    assert split(one.handle(late, 2 * GRID_NS + 1))[0] == []
    one.handle(acknowledgement(second), 2 * GRID_NS + 2)
    np.testing.assert_allclose(state_of(one, "x_s"), transition(H, 1) @ [2.0, 0.0], rtol=1e-14)


def test_an_acknowledgement_of_an_unsent_update_changes_nothing() -> None:
    one = sensor(x0=[1.0, 1.0])
    before = state_of(one, "x_s")
    _, row = split(one.handle(Message(Flow.ACKNOWLEDGEMENT, 7, 0, NO_VECTOR), 5))
    assert row["x_s"].tobytes() == row["x_s_before"].tobytes() == before.tobytes()

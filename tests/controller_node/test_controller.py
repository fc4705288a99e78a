"""The controller's model, inputs and predictions, in closed form.

Whole runs are compared with a reference loop in tests/cosim/simulation/test_whole_loop.py, changes
during a run are in tests/cosim/record/test_recorded_changes.py, users' control laws in
tests/noack/controllers/. Updates that are older than the newest one do not reach the controller:
the receiver rejects them (tests/noack/protocol/test_wire_format.py).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from controller_node.controller import Controller
from noack.controllers.linear_feedback import LinearFeedback
from noack.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from noack.protocol.record_tables import CONTROLLER_DELIVERY, tables
from noack.protocol.roles import Notice, Output, Record
from noack.protocol.wire_format import Flow, Message
from tests.helpers.machine_parts import OneLoop, machine

MS = 1_000_000
H = np.array([[-0.5, 2.0], [-1.0, 0.3]])
K = np.array([[1.5, -0.7], [0.1, 2.0], [0.0, 1.0]])
X = np.array([1.0, -2.0])
SAFE = np.array([0.3, 0.2, 0.1])
PERIOD_MS = 2


def new_controller(**more: Any) -> OneLoop:
    controller = Controller(
        H, LinearFeedback(K), inputs=len(K), period_ns=PERIOD_MS * MS, first_ns=0, horizon_ns=10**9,
        guarantee=LossGuarantee((LongestBurst(2),)), safe_input=SAFE, **more,
    )  # fmt: skip
    return machine(controller)


def update(sequence: int, t_ms: int) -> Message:
    return Message(Flow.UPDATE, sequence, t_ms * MS, X)


def after(t_ms: float) -> np.ndarray:
    """The model's state ``t_ms`` after it was X."""
    state: np.ndarray = expm(H * t_ms * 1e-3) @ X
    return state


def inputs(outputs: Sequence[Output]) -> np.ndarray:
    """The inputs of an actuation, one per row."""
    (message,) = [output for output in outputs if isinstance(output, Message)]
    return message.vector.reshape(-1, len(K))


def test_a_late_update_restores_the_sensors_model() -> None:
    """Sent at 3 ms and delivered after the tick of 6 ms, with the loss of the two before it."""
    controller = new_controller()
    for t_ms in range(0, 8, PERIOD_MS):
        np.testing.assert_array_equal(inputs(controller.on_timer(t_ms * MS)), [SAFE])
    *records, notice = controller.handle(update(2, 3), 7 * MS)
    (row,) = np.array([record.row for record in records if isinstance(record, Record)],
                      tables(2, 3)[CONTROLLER_DELIVERY])  # fmt: skip
    assert (row["t_ns"], row["model_t_ns"], row["dropouts"]) == (3 * MS, 6 * MS, 2)
    np.testing.assert_allclose(row["x_c"], after(3), rtol=1e-13)
    assert isinstance(notice, Notice)
    assert notice.text.startswith("no delivered t_0: 2 updates")
    np.testing.assert_allclose(inputs(controller.on_timer(8 * MS)), [K @ after(5)], rtol=1e-13)


@pytest.mark.parametrize("holds", [False, True])
def test_an_update_of_the_timeouts_age_is_replaced_by_the_safe_or_the_last_input(holds: bool) -> None:
    controller = new_controller(timeout_ns=4 * MS, holds_input=holds)
    controller.handle(update(0, 0), 0)
    sent = [inputs(controller.on_timer(t_ms * MS))[0] for t_ms in (0, 2, 4, 6)]
    then = K @ after(2) if holds else SAFE
    np.testing.assert_allclose(sent, [K @ X, K @ after(2), then, then], rtol=1e-13)
    controller.handle(update(1, 7), 7 * MS)
    np.testing.assert_allclose(inputs(controller.on_timer(8 * MS)), [K @ after(1)], rtol=1e-13)


def test_predictions_are_the_inputs_of_the_following_ticks_without_an_update() -> None:
    """The last one is for the timeout's age, from which on the input is the safe one."""
    controller = new_controller(predictions=4, timeout_ns=6 * MS)
    np.testing.assert_array_equal(inputs(controller.on_timer(0)), [SAFE] * 4)
    controller.handle(update(0, 1), MS)
    predicted = inputs(controller.on_timer(2 * MS))
    np.testing.assert_allclose(predicted, [K @ after(1), K @ after(3), K @ after(5), SAFE], rtol=1e-13)
    np.testing.assert_array_equal(inputs(controller.on_timer(4 * MS))[0], predicted[1])

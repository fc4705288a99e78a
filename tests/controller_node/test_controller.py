"""The controller: its model, inputs and predictions in closed form, and its check of losses.

Whole runs are compared with a reference loop in tests/cosim/simulation/test_whole_loop.py, changes
during a run are in tests/cosim/record/test_recorded_changes.py, users' control laws in
tests/noack/controllers/. Updates that are older than the newest one do not reach the controller:
the receiver rejects them (tests/noack/protocol/test_wire_format.py).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from controller_node.controller import Controller, LossCheck
from noack.controllers.linear_feedback import LinearFeedback
from noack.core.periods import Period
from noack.guarantee.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossRule,
)
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
        H, LinearFeedback(K), inputs=len(K), period=Period(PERIOD_MS * MS), first_ns=0, horizon_ns=10**9,
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


def check_of(mansd: int, *constraints: LossRule, known_start: bool = True) -> LossCheck:
    return LossCheck(LossGuarantee((LongestBurst(mansd), *constraints)), None, known_start=known_start)


def violations(check: LossCheck, sequence: int, losses: int) -> Sequence[str]:
    """Add an update that was sent at ``sequence`` milliseconds."""
    notices = check.add(sequence, sequence - losses - 1, losses, sequence * MS, sequence * MS)
    assert all((notice.t_ns, notice.level) == (sequence * MS, "violation") for notice in notices)
    return [notice.text for notice in notices]


@given(st.lists(st.booleans(), max_size=25))
def test_further_constraints_are_checked_over_all_updates_so_far(delivered: list[bool]) -> None:
    """At most 2 losses in 5, and 2 deliveries between bursts; each against its definition."""
    window, recovery = LossesInWindow(2, 5), DeliveriesBetweenBursts(2)
    check = check_of(30, window, recovery)
    last = -1
    for i in (number for number, arrives in enumerate(delivered) if arrives):
        texts = violations(check, i, i - last - 1)
        ends = range(last + 1, i)  # the losses that this update shows
        too_many = any(sum(not arrives for arrives in delivered[max(j - 4, 0) : j + 1]) > 2 for j in ends)
        too_soon = i - last > 1 and delivered[last - 1 : last + 1] == [False, True]
        assert sorted(text.partition(" violated")[0] for text in texts) == [
            rule.name for rule, broken in ((window, too_many), (recovery, too_soon)) if broken
        ]
        last = i


@pytest.mark.parametrize(
    ("known", "lost", "expected"),
    [
        (False, 0, None),
        (False, 1, "no delivered t_0: 1 update was lost before"),
        (False, 2, "no delivered t_0: 2 updates were lost before"),
        (False, 3, "MANSD violated: 3 consecutive losses"),
        (True, 0, None),
        (True, 2, None),
        (True, 3, "MANSD violated: 3 consecutive losses"),
    ],
)
def test_lost_first_updates_are_a_violation_without_a_known_start(
    known: bool, lost: int, expected: str | None
) -> None:
    check = check_of(2, known_start=known)
    texts = violations(check, lost, lost)
    assert len(texts) == (expected is not None)
    assert all(text.startswith(str(expected)) for text in texts)
    # The flow has begun: a gap within the limit is no violation.
    assert violations(check, lost + 2, 1) == []

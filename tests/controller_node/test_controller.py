from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller_node.controller import Controller
from noack.controllers.linear_feedback import LinearFeedback
from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossRule,
)
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, tables
from noack.protocol.roles import Notice, Output, Record
from noack.protocol.wire_format import Flow, Message
from tests.helpers.machine_parts import OneLoop, machine

MS = 1_000_000
H = np.array([[-0.5, 2.0], [-1.0, 0.3]])
K = np.array([[1.5, -0.7], [0.1, 2.0], [0.0, 1.0]])


def new_controller(
    mansd: int = 2,
    x0: np.ndarray | None = None,
    first_ns: int = MS,
    horizon_ns: int = 10**9,
    constraints: Sequence[LossRule] = (),
    **more: Any,
) -> OneLoop:
    controller = Controller(
        H,
        LinearFeedback(K),
        inputs=len(K),
        period_ns=2 * MS,
        first_ns=first_ns,
        horizon_ns=horizon_ns,
        guarantee=LossGuarantee((LongestBurst(mansd), *constraints)),
        x0=x0,
        **more,
    )
    return machine(controller)


def update(sequence: int, t_ns: int, x: Sequence[float] = (1.0, -2.0)) -> Message:
    return Message(Flow.UPDATE, sequence, t_ns, np.array(x))


def tick(controller: OneLoop) -> tuple[Message, Any]:
    """Execute the next tick on time; return the actuation and its row."""
    t_ns = controller.next_deadline_ns()
    assert t_ns is not None
    message, record = controller.on_timer(t_ns)
    assert isinstance(message, Message)
    (row,) = rows([record], CONTROLLER_STEP)
    return message, row


def rows(outputs: Sequence[Output], table: str) -> Any:
    found = [out.row for out in outputs if isinstance(out, Record) and out.table == table]
    return np.array(found, tables(2, 3)[table])


def notices(outputs: Sequence[Output]) -> list[Notice]:
    return [output for output in outputs if isinstance(output, Notice)]


@given(st.lists(st.booleans(), max_size=25))
def test_further_constraints_are_checked_over_all_updates_so_far(delivered: list[bool]) -> None:
    """At most 2 losses in 5, and 2 deliveries between bursts; each against its definition."""
    window, recovery = LossesInWindow(2, 5), DeliveriesBetweenBursts(2)
    controller = new_controller(mansd=30, x0=np.ones(2), constraints=(window, recovery))
    last = -1
    for i in (number for number, arrives in enumerate(delivered) if arrives):
        found = notices(controller.handle(update(i, i * MS), i * MS))
        ends = range(last + 1, i)  # the losses that this update shows
        too_many = any(sum(not one for one in delivered[max(j - 4, 0) : j + 1]) > 2 for j in ends)
        too_soon = i - last > 1 and delivered[last - 1 : last + 1] == [False, True]
        assert [one.text.partition(" violated")[0] for one in found] == [
            rule.name for rule, broken in ((window, too_many), (recovery, too_soon)) if broken
        ]
        last = i


@pytest.mark.parametrize(
    ("known", "lost", "expected"),
    [
        (False, 0, None),
        (False, 1, "no delivered t_0"),
        (False, 2, "no delivered t_0"),
        (False, 3, "MANSD violated: 3 successive dropouts"),
        (True, 0, None),
        (True, 2, None),
        (True, 3, "MANSD violated: 3 successive dropouts"),
    ],
)
def test_lost_first_updates_are_a_violation_without_a_known_start(
    known: bool, lost: int, expected: str | None
) -> None:
    controller = new_controller(mansd=2, x0=np.ones(2) if known else None)
    outputs = controller.handle(update(lost, 5 * MS), 6 * MS)
    (row,) = rows(outputs, CONTROLLER_DELIVERY)
    assert row["dropouts"] == lost
    if expected is None:
        assert notices(outputs) == []
    else:
        (notice,) = notices(outputs)
        assert (notice.t_ns, notice.level) == (5 * MS, "violation")
        assert notice.text.startswith(expected)
        assert str(lost) in notice.text or lost == 1
    # The flow has begun: a gap within the cap is no violation.
    assert notices(controller.handle(update(lost + 2, 7 * MS), 8 * MS)) == []

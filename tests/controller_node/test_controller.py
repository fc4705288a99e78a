"""The controller's check of losses.

Its model, inputs and predictions are compared with a reference loop in
tests/cosim/simulation/test_whole_loop.py, changes during a run are in
tests/cosim/record/test_recorded_changes.py, users' control laws in tests/noack/controllers/.
Updates that are older than the newest one do not reach the controller: the receiver rejects them
(tests/noack/protocol/test_wire_format.py).
"""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller_node.controller import LossCheck
from netem.guarantee.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossRule,
)

MS = 1_000_000


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

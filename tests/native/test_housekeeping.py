"""When a driver returns to Python for housekeeping that is due."""

import pytest

from netem.core.core_library import core, ffi

US, MS = 1_000, 1_000_000
FAR, NEAR = 20 * MS, 400 * US
"""Times until the next tick: housekeeping ends before it, or may not."""


@pytest.mark.parametrize(
    ("worked_since_wait", "worked_since_due", "overdue", "next_tick", "has_more", "is_busy", "put_off"),
    [
        pytest.param(0, 0, 1 * MS, FAR, 0, 0, 9 * MS, id="until a step, 10 ms at most"),
        pytest.param(1, 0, 1 * MS, FAR, 0, 0, 200 * US, id="for a moment after a step"),
        pytest.param(0, 1, 1 * MS, FAR, 0, 0, 0, id="not in the pause after a step"),
        pytest.param(1, 1, 10 * MS, FAR, 0, 0, 0, id="not after 10 ms without a pause"),
        pytest.param(1, 0, 1 * MS, FAR, 0, 1, 0, id="not if no pause is to be expected"),
        pytest.param(0, 0, 12 * MS, NEAR, 0, 0, 200 * US, id="while a tick is near"),
        pytest.param(0, 1, 1 * MS, FAR, 1, 0, 49 * MS, id="while datagrams wait"),
        pytest.param(1, 0, 50 * MS, NEAR, 1, 1, 0, id="50 ms at most"),
    ],
)  # fmt: skip
def test_housekeeping_is_put_off(
    worked_since_wait: int, worked_since_due: int, overdue: int, next_tick: int, has_more: int,
    is_busy: int, put_off: int,
) -> None:  # fmt: skip
    pauses = ffi.new("noack_pauses *", [worked_since_wait, worked_since_due])
    assert core.noack_put_off_ns(pauses, overdue, next_tick, has_more, is_busy) == put_off
    has_worked = worked_since_wait or worked_since_due
    assert pauses.worked_since_due == (has_worked if put_off else 0)

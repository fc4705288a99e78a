from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.reorder import Reorder
from noack.impairments.link_settings import LinkSettings

FIXED = Delay(delay_s=0.01)


@pytest.mark.parametrize("gap", [1, 2, 5])
def test_reordered_packets_leave_at_once(
    decide: Any, share_is: Callable[..., None], gap: int
) -> None:
    decided = decide([FIXED, Reorder(probability=0.3, gap=gap)], 200_000)
    at_once = decided.delays_ns == 0
    assert set(decided.delays_ns.tolist()) == {0, 10_000_000}
    turns = np.arange(1, 200_001) % gap == 0
    assert not at_once[~turns].any()
    share_is(at_once[turns], 0.3)


def test_with_probability_1_one_packet_per_gap_is_reordered(decide: Any) -> None:
    decided = decide([FIXED, Reorder(gap=4)], 100)
    assert np.flatnonzero(decided.delays_ns == 0).tolist() == list(range(3, 100, 4))


def test_only_delays_before_the_reorder_are_skipped(decide: Any) -> None:
    decided = decide([FIXED, Reorder(), Delay(delay_s=0.003)], 10)
    assert (decided.delays_ns == 3_000_000).all()


def test_reordered_packets_are_held_back_for_the_guarantee(decide: Any) -> None:
    """Every fifth packet would overtake four packets; with cap 2 it waits for the second one."""
    freely = decide(LinkSettings(impairments=(FIXED, Reorder(gap=5)), mansd=4), 50)
    assert freely.verdicts["makes_stale"].reshape(-1, 5).tolist() == [[0, 0, 0, 0, 4]] * 10
    capped = decide(LinkSettings(impairments=(FIXED, Reorder(gap=5)), mansd=2), 50)
    of_five = capped.verdicts.reshape(-1, 5)
    assert (of_five["makes_stale"] == [0, 0, 0, 0, 2]).all()
    assert (of_five["release_ns"][:, 4] == of_five["release_ns"][:, 1]).all()
    assert (of_five["hold_back_ns"][:, 4] > 0).all()
    assert (of_five["hold_back_ns"][:, :4] == 0).all()

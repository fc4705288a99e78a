"""Corruption, duplicates and reordering."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats


@pytest.mark.parametrize("size_bytes", [1, 100, 65_507])
def test_every_bit_is_flipped_with_the_same_probability(
    decide: Any, share_is: Callable[..., None], size_bytes: int
) -> None:
    decided = decide("corrupt 50%", 200_000, sizes_bytes=size_bytes)
    bits = decided.decisions["bit"][decided.fates == 3]
    share_is(decided.fates == 3, 0.5)
    assert ((decided.decisions["bit"] >= 0) == (decided.fates == 3)).all()
    assert bits.min() >= 0
    assert bits.max() < 8 * size_bytes
    empty = decide("corrupt 100%", 100, sizes_bytes=np.arange(100) % 2)
    assert empty.fates.tolist() == [0, 3] * 50
    counts = np.histogram(bits, min(8 * size_bytes, 800), (0, 8 * size_bytes))[0]
    assert stats.chisquare(counts).pvalue > 1e-4


def test_a_share_is_sent_twice(decide: Any, share_is: Callable[..., None]) -> None:
    decided = decide("duplicate 20%", 100_000)
    copied = decided.decisions["copy_ns"] >= 0
    share_is(copied, 0.2)
    assert (decided.fates == 0).all()
    assert (decided.decisions["copy_ns"] == np.where(copied, decided.arrivals_ns, -1)).all()


def test_the_earlier_of_original_and_copy_leaves_first(decide: Any) -> None:
    decided = decide("duplicate 100% delay 10ms 5ms", 100_000)
    first, second = decided.decisions["release_ns"], decided.decisions["copy_ns"]
    assert (first <= second).all()
    # The mean difference of two independent uniform delays is a third of their range.
    assert abs(np.mean(second - first) / 10_000_000 - 1 / 3) < 0.005


@pytest.mark.parametrize("gap", [1, 5])
def test_reordered_packets_leave_at_once(
    decide: Any, share_is: Callable[..., None], gap: int
) -> None:
    decided = decide(f"delay 10ms reorder 30% gap {gap}", 100_000)
    at_once = decided.delays_ns == 0
    assert set(decided.delays_ns.tolist()) == {0, 10_000_000}
    turns = np.arange(1, 100_001) % gap == 0
    assert not at_once[~turns].any()
    share_is(at_once[turns], 0.3)
    # Only delays before the reorder are skipped.
    assert (decide("delay 10ms reorder 100% delay 3ms", 10).delays_ns == 3_000_000).all()


def test_reordered_packets_are_held_back_for_the_guarantee(decide: Any) -> None:
    """Every fifth packet would overtake four packets; with cap 2 it waits for the second one."""
    freely = decide("delay 10ms gap 5 mansd 4", 50).decisions
    assert freely["makes_stale"].reshape(-1, 5).tolist() == [[0, 0, 0, 0, 4]] * 10
    of_five = decide("delay 10ms gap 5 mansd 2", 50).decisions.reshape(-1, 5)
    assert (of_five["makes_stale"] == [0, 0, 0, 0, 2]).all()
    assert (of_five["release_ns"][:, 4] == of_five["release_ns"][:, 1]).all()
    assert ((of_five["hold_back_ns"] > 0) == [False, False, False, False, True]).all()

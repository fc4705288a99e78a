from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from netem.link_machine import flipped
from noack.impairments.kinds.corrupt import Corrupt
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.link_settings import LinkSettings


@pytest.mark.parametrize("size_bytes", [1, 2, 100, 65_507])
def test_any_bit_is_as_likely_as_any_other(
    decide: Any, share_is: Callable[..., None], size_bytes: int
) -> None:
    decided = decide([Corrupt(probability=0.5)], 400_000, sizes_bytes=size_bytes)
    bits = decided.verdicts["bit"][decided.fates == 3]
    share_is(decided.fates == 3, 0.5)
    assert ((decided.verdicts["bit"] >= 0) == (decided.fates == 3)).all()
    assert bits.min() >= 0
    assert bits.max() < 8 * size_bytes
    if size_bytes <= 100:
        counts = np.bincount(bits, minlength=8 * size_bytes)
    else:
        counts = np.histogram(bits, 256, (0, 8 * size_bytes))[0]
    assert stats.chisquare(counts, np.full(len(counts), len(bits) / len(counts))).pvalue > 1e-4


def test_exactly_one_bit_is_flipped() -> None:
    data = bytes(range(7))
    for bit in range(56):
        changed = int.from_bytes(flipped(data, bit), "little") ^ int.from_bytes(data, "little")
        assert changed == 1 << bit


def test_nothing_in_an_empty_payload_can_be_corrupted(decide: Any) -> None:
    decided = decide([Corrupt(probability=1.0)], 100, sizes_bytes=np.arange(100) % 2)
    assert decided.fates.tolist() == [0, 3] * 50


def test_packets_that_must_pass_are_not_corrupted(decide: Any) -> None:
    settings = LinkSettings(impairments=(Corrupt(probability=1.0),), mansd=2, first_delivered=True)
    decided = decide(settings, 9)
    assert decided.fates.tolist() == [2, 3, 3] * 3
    assert ((decided.verdicts["bit"] < 0) == (decided.fates == 2)).all()


def test_copies_are_corrupted_independently(decide: Any, share_is: Callable[..., None]) -> None:
    """If corruption comes after duplication. Otherwise both carry the same flipped bit."""
    after = decide([Duplicate(probability=1.0), Corrupt(probability=0.4)], 200_000).verdicts
    first, second = after["bit"] >= 0, after["copy_bit"] >= 0
    share_is(first, 0.4)
    share_is(second, 0.4)
    share_is(first & second, 0.16)
    # An intact copy counts as delivery of the original.
    np.testing.assert_array_equal(after["fate"] == 3, first & second)
    before = decide([Corrupt(probability=0.4), Duplicate(probability=1.0)], 1000).verdicts
    np.testing.assert_array_equal(before["bit"], before["copy_bit"])
